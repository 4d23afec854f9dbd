"""One parser for every form of a detection: of the command line, of Python and of the HTTP interface.

    {"min": [..], "max": [..]} · [[min], [max]]              an axis-aligned box
    {"center": [..], "size": [..]}                           the same by its center and full edge lengths
     + "rotation": 3x3 | {"x":, "y":, "z":, "w":}            box axes to scene axes
     + "rotation_quaternion_xyzw" | "rotation_quaternion_wxyz"
    {"center": .., "extent": .., "R": ..}                    Open3D's OrientedBoundingBox
    {"min_bound": .., "max_bound": ..}                       Open3D's AxisAlignedBoundingBox

Points and sizes may be objects {"x":, "y":, "z":}, as ROS has them. What does not say enough is refused: a bare list of
four numbers as `rotation` may have either order. Other names are refused with what to write.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from regnf_core.detections.bounds import Detection, Place, edges, fault, number, numbers, point, shown
from regnf_core.errors import InvalidDetectionError, suggestion
from regnf_core.library_entries import LABEL_PATTERN
from regnf_core.rotations import IDENTITY, Quaternion, determinant, orthonormality_error, quaternion_of

# The names that a detection's members have in the wild: those that are taken, and what to write for the others.

CANONICAL = {
    "center": "center",
    "size": "size",
    "extent": "size",  # Open3D
    "rotation": "rotation",
    "R": "rotation",  # Open3D
    "rotation_quaternion_xyzw": "rotation_quaternion_xyzw",
    "rotation_quaternion_wxyz": "rotation_quaternion_wxyz",
    "min": "min",
    "min_bound": "min",  # Open3D
    "max": "max",
    "max_bound": "max",  # Open3D
    "label": "label",
    "score": "score",
}
"""Each name that is taken, and the member that it stands for."""

ROTATIONS = ("rotation", "rotation_quaternion_xyzw", "rotation_quaternion_wxyz")

OPEN3D_NAMES = frozenset({"extent", "R", "min_bound", "max_bound"})
OPEN3D_EXTRA = frozenset({"class_name", "color", "version_major", "version_minor"})
"""Members of Open3D's documents that say nothing about the box."""

_ORDER = (
    "Say the order of the quaternion: `rotation_quaternion_xyzw` (ROS, SciPy) or `rotation_quaternion_wxyz` (Eigen's "
    "constructor, nuScenes, COLMAP)."
)
_TURN = "A rotation by the angle a about z is `rotation_quaternion_xyzw`: [0, 0, sin(a/2), cos(a/2)]."
_HALF = "Write `size`: the full edge lengths, twice these."
_CORNERS = "Write the lowest and the highest corner: `min`: [x, y, z] and `max`: [x, y, z]."
INSTEAD = {
    "quaternion": _ORDER,
    "rotation_quaternion": _ORDER,
    "orientation": _ORDER,
    "quat": _ORDER,
    "qvec": _ORDER,
    "yaw": _TURN,
    "heading": _TURN,
    "rotation_y": _TURN,
    "rotation_z": _TURN,
    "angle": _TURN,
    "euler": "Write `rotation` as a 3x3 matrix: Euler angles do not say their order.",
    "half_extents": _HALF,
    "half_extent": _HALF,
    "half_size": _HALF,
    "dimensions": "Datasets order dimensions differently. Write `size`: [x, y, z], the full edge lengths.",
    "wlh": "Write `size`: [x, y, z], the full edge lengths; for nuScenes' boxes that is [length, width, height].",
    "lwh": "Write `size`: [x, y, z], the full edge lengths along the box's own axes.",
    "hwl": "Write `size`: [x, y, z], the full edge lengths along the box's own axes.",
    "bounds": _CORNERS,
    "bbox": _CORNERS,
    "box": _CORNERS,
    "aabb": _CORNERS,
    "corners": _CORNERS,
    "vertices": _CORNERS,
    "lower": "Did you mean `min`?",
    "upper": "Did you mean `max`?",
    "position": "Did you mean `center`?",
    "location": "Did you mean `center`?",
    "translation": "Did you mean `center`? A box of nuScenes has `size` [width, length, height] and "
    "`rotation` [w, x, y, z]: write `size`: [length, width, height] and `rotation_quaternion_wxyz`.",
    "extents": "Did you mean `size`?",
    "rotation_matrix": "Did you mean `rotation`?",
    "class": "Did you mean `label`?",
    "name": "Did you mean `label`?",
    "category": "Did you mean `label`?",
    "confidence": "Did you mean `score`?",
    "probability": "Did you mean `score`?",
}
"""What to write for names that are not taken: most of them do not say enough."""

FORMS = (
    'Write {"min": [x, y, z], "max": [x, y, z]} or {"center": [x, y, z], "size": [x, y, z], "rotation": [[3], [3], '
    "[3]]}, in the scene's frame and units. docs/api.md lists every form."
)


# A detection's rotation: a 3x3 matrix, or a quaternion that says its order.

MAX_COMPONENT = 1e3
MAX_ORTHONORMALITY_ERROR = 1e-3
"""Largest entry of |R R^T - I|: matrices written with four digits pass."""
_MIN_NORM = 1e-6
_ROWS = "Write three rows of three numbers; the columns are the box's axes in the scene."


def read_quaternion(value: Any, place: Place, order: str) -> Quaternion:
    """A quaternion whose components come in ``order``, as x, y, z, w."""
    components = dict(zip(order, numbers(value, place, order, MAX_COMPONENT), strict=True))
    if math.hypot(*components.values()) < _MIN_NORM:
        raise fault(place, "is zero, expected a quaternion with a direction", "Leave it out for an upright box.")
    return components["x"], components["y"], components["z"], components["w"]


def read_rotation(value: Any, place: Place) -> Quaternion:
    """The quaternion (x, y, z, w) of `rotation`: three rows, or an object {x, y, z, w}."""
    if isinstance(value, Mapping):
        return read_quaternion(value, place, "xyzw")
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise fault(place, f"is {shown(value)}, expected a 3x3 matrix", _ROWS)
    if len(value) == 4 and not any(isinstance(part, Sequence) for part in value):
        raise _either_order(value, place)
    if len(value) != 3 or not all(isinstance(row, Sequence) and len(row) == 3 for row in value):
        raise fault(place, f"is {shown(value)}, expected a 3x3 matrix", _ROWS)
    rows = [[number(part, (*place, i, j), MAX_COMPONENT) for j, part in enumerate(row)] for i, row in enumerate(value)]
    _require_rotation(rows, place)
    identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return IDENTITY if rows == identity else quaternion_of(rows)


def _either_order(value: Sequence[Any], place: Place) -> Exception:
    listed = ", ".join(f"{number(part, (*place, i), MAX_COMPONENT):g}" for i, part in enumerate(value))
    hint = (
        f"Write `rotation_quaternion_xyzw`: [{listed}] if the last number is w, "
        f"`rotation_quaternion_wxyz`: [{listed}] if the first one is."
    )
    return fault(place, f"is four numbers, [{listed}]: a quaternion of unknown order", hint)


def _require_rotation(rows: Sequence[Sequence[float]], place: Place) -> None:
    error = orthonormality_error(rows)
    if error > MAX_ORTHONORMALITY_ERROR:
        hint = "Its rows must be perpendicular and of length 1: keep the scale in `size`, and write more digits."
        raise fault(place, f"is no rotation: R R^T differs from the identity by {error:.2g}", hint)
    if determinant(rows) < 0:
        hint = "Negate one column: a box looks the same, and its axes are right-handed then."
        raise fault(place, "is a reflection, of determinant -1, expected a rotation, of determinant 1", hint)


# A document with several detections: which one is meant is asked, never guessed.

_LISTS = ("detections", "boxes", "objects", "predictions", "results")
_MAX_LISTED = 5


def chosen(values: Any, index: int | None) -> Any:
    """The one detection of a document: all of it, or the entry ``index`` of its list. Raises InvalidDetectionError."""
    name, entries = _entries(values)
    if entries is None:
        if index is not None:
            raise fault((), f"is a single box, and the entry {index} was asked for", "Leave the index out.")
        return values
    if not entries:
        raise fault((name,) if name else (), "is an empty list, expected a box", FORMS)
    if index is None:
        raise _ambiguous(name, entries)
    if not 0 <= index < len(entries):
        last = len(entries) - 1
        raise fault((name,) if name else (), f"has no entry {index}", f"Choose one of 0 to {last}.")
    return entries[index]


def _entries(values: Any) -> tuple[str | None, list[Any] | None]:
    """The list of detections in a document, and the member that holds it."""
    if isinstance(values, list) and (not values or any(isinstance(entry, Mapping) for entry in values)):
        return None, values
    if isinstance(values, Mapping):
        for name in _LISTS:
            if isinstance(values.get(name), list):
                return name, values[name]
    return None, None


def _ambiguous(name: str | None, entries: Sequence[Any]) -> InvalidDetectionError:
    listed = ", ".join(f"{number}: {_summary(entry)}" for number, entry in enumerate(entries[:_MAX_LISTED]))
    more = f" and {len(entries) - _MAX_LISTED} more" if len(entries) > _MAX_LISTED else ""
    count = "1 detection" if len(entries) == 1 else f"{len(entries)} detections"
    hint = f"Give the entry alone, without the list; at the command line --detection-index chooses it. {listed}{more}"
    return fault((name,) if name else (), f"is a list of {count}, expected one box", hint)


def _summary(entry: Any) -> str:
    if not isinstance(entry, Mapping):
        return shown(entry)
    label = next((entry[key] for key in ("label", "class", "name") if key in entry), None)
    score = next((entry[key] for key in ("score", "confidence") if key in entry), None)
    words = [shown(value) for value in (label, score) if isinstance(value, str | int | float)]
    return " ".join(words) or "a box"


_MAX_LABEL = 200
_LABEL = re.compile(LABEL_PATTERN)


def parse_detection(values: Any, index: int | None = None) -> Detection:
    """The detection that plain (JSON) values say. ``index`` chooses one where a document holds several.

    Raises InvalidDetectionError; its ``place`` tells where in ``values`` the fault is, its ``hint`` what to write.
    """
    values = chosen(_plain(values), index)
    if _is_pair_of_corners(values):
        return _by_corners(values[0], values[1], (0,), (1,), {})
    if not isinstance(values, Mapping):
        raise fault((), f"is {shown(values)}, expected an object with a box", FORMS)
    return _by_members(*_members(values))


def _plain(value: Any) -> Any:
    """Arrays of NumPy and torch, and tuples, as lists."""
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


def _is_pair_of_corners(values: Any) -> bool:
    return isinstance(values, Sequence) and len(values) == 2 and all(isinstance(part, list) for part in values)


def _members(values: Mapping[Any, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """The members by their canonical names, and the names that were written for them."""
    extra = OPEN3D_EXTRA if values.keys() & OPEN3D_NAMES else frozenset()
    found: dict[str, Any] = {}
    written: dict[str, str] = {}
    unknown = [name for name in values if name not in CANONICAL and name not in extra]
    if unknown:
        name = min(unknown, key=lambda name: name not in INSTEAD)  # the one that says what is meant
        raise fault((str(name),), "is not a member of a detection", INSTEAD.get(name) or _meant(name))
    for name, value in values.items():
        member = CANONICAL.get(name)
        if member in found:
            raise fault((name,), f"says the same as `{written[member]}`", "Leave one of the two out.")
        if member is not None:
            found[member], written[member] = value, str(name)
    return found, written


def _meant(name: Any) -> str:
    return suggestion(str(name), CANONICAL.values()) or FORMS


def _by_members(found: dict[str, Any], written: dict[str, str]) -> Detection:
    corners, rest = found.keys() & {"min", "max"}, found.keys() & {"center", "size", *ROTATIONS}
    if corners and rest:
        extra = written[min(rest)]
        raise fault((extra,), "goes with `center` and `size`, but the box has corners too", "Leave one of them out.")
    required = ("min", "max") if corners else ("center", "size")
    for member in required:
        if member not in found:
            other = next((written[name] for name in required if name in found), None)
            text = f"is missing: `{other}` is there" if other else "is missing"
            raise fault((member,), text, FORMS)
    if corners:
        return _by_corners(found["min"], found["max"], (written["min"],), (written["max"],), found)
    center = point(found["center"], (written["center"],))
    size = edges(found["size"], (written["size"],))
    return Detection(center, size, _rotation(found, written), **_labels(found))


def _rotation(found: dict[str, Any], written: dict[str, str]) -> Quaternion:
    given = [name for name in ROTATIONS if name in found]
    if not given:
        return IDENTITY
    if len(given) > 1:
        raise fault((written[given[1]],), f"says the same as `{written[given[0]]}`", "Leave one of the two out.")
    place: Place = (written[given[0]],)
    if given[0] == "rotation":
        return read_rotation(found["rotation"], place)
    return read_quaternion(found[given[0]], place, given[0].removeprefix("rotation_quaternion_"))


def _by_corners(low: Any, high: Any, low_place: Place, high_place: Place, found: dict[str, Any]) -> Detection:
    lower, upper = point(low, low_place), point(high, high_place)
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        if a >= b:
            swapped = all(p > q for p, q in zip(lower, upper, strict=True))
            hint = "min and max look swapped." if swapped else "min is the lowest corner, max the highest."
            raise fault((*high_place, i), f"is {b:g}, expected more than min[{i}], which is {a:g}", hint)
    center = tuple((a + b) / 2 for a, b in zip(lower, upper, strict=True))
    size = tuple(b - a for a, b in zip(lower, upper, strict=True))
    return Detection(center, size, IDENTITY, **_labels(found))  # type: ignore[arg-type]  # of three, as the corners are


def _labels(found: Mapping[str, Any]) -> dict[str, Any]:
    label, score = found.get("label"), found.get("score")
    if label is not None and not (isinstance(label, str) and _LABEL.match(label) and 0 < len(label) <= _MAX_LABEL):
        raise fault(("label",), f"is {shown(label)}, expected 1 to {_MAX_LABEL} printable characters")
    if score is not None and not 0.0 <= number(score, ("score",)) <= 1.0:
        hint = "Divide a percentage by 100." if 1 < score <= 100 else None
        raise fault(("score",), f"is {shown(score)}, expected a number from 0 to 1", hint)
    return {"label": label, "score": None if score is None else float(score)}


# Boxes as other libraries have them: read by their attributes, so that none of these is needed here.

_ORIENTED = ("center", "extent", "R")
_ALIGNED = ("min_bound", "max_bound")


class HasDetection(Protocol):
    """A box of this library."""

    def to_detection(self) -> Detection: ...


class Open3DOrientedBox(Protocol):
    """Open3D's OrientedBoundingBox."""

    @property
    def center(self) -> Any: ...
    @property
    def extent(self) -> Any: ...
    @property
    def R(self) -> Any: ...  # noqa: N802 -- Open3D's name


class Open3DAlignedBox(Protocol):
    """Open3D's AxisAlignedBoundingBox."""

    @property
    def min_bound(self) -> Any: ...
    @property
    def max_bound(self) -> Any: ...


BoxLike = (
    HasDetection
    | Open3DOrientedBox
    | Open3DAlignedBox
    | Detection
    | Mapping[str, Any]
    | Sequence[Any]
    | os.PathLike[str]
)
"""A box, an Open3D box, a detection's JSON in any of its forms or its file's path, or a lowest and a highest corner."""


def detection_of(box: Any) -> Detection:
    """The detection that a box of any kind stands for. Raises InvalidDetectionError with what to write instead."""
    if isinstance(box, Detection):
        return box
    if callable(getattr(box, "to_detection", None)):
        found: Detection = box.to_detection()
        return found
    for names in (_ORIENTED, _ALIGNED):
        if _is_open3d(box, names):
            return parse_detection({name: getattr(box, name) for name in names})
    return parse_detection(box)


def open3d_detection(box: Any) -> Detection:
    """The same of an Open3D box alone. Raises InvalidDetectionError for anything else."""
    if isinstance(box, Mapping) or not any(
        all(hasattr(box, name) for name in names) for names in (_ORIENTED, _ALIGNED)
    ):
        hint = (
            "Give an OrientedBoundingBox or an AxisAlignedBoundingBox; OrientedBox.from_dict takes a detection's JSON."
        )
        raise InvalidDetectionError(f"a {type(box).__name__} is no box of Open3D", hint=hint)
    return detection_of(box)


def _is_open3d(box: Any, names: Sequence[str]) -> bool:
    return not isinstance(box, Mapping) and all(hasattr(box, name) for name in names)
