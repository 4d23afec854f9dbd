"""One parser for every form of a detection: of the command line, of Python and of the HTTP interface.

    {"min": [..], "max": [..]}                               an axis-aligned box
    [[min], [max]]                                           the same, where no center and size is possible: a max <= 0
    {"center": [..], "size": [..]}                           the same by its center and full edge lengths
     + "rotation": 3x3 | {"x":, "y":, "z":, "w":}            box axes to scene axes
     + "rotation_quaternion_xyzw" | "rotation_quaternion_wxyz"
    {"center": .., "extent": .., "R": ..}                    Open3D's OrientedBoundingBox
    {"min_bound": .., "max_bound": ..}                       Open3D's AxisAlignedBoundingBox

Points and sizes may be objects {"x":, "y":, "z":}, as ROS has them. Ambiguous forms are refused: a list of four numbers
as `rotation` may have either order. Other names are refused with a hint.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from regnf_core.detections.bounds import Detection, Place, edges, fault, number, numbers, point, shown
from regnf_core.errors import suggestion
from regnf_core.library_entries import LABEL_PATTERN
from regnf_core.rotations import IDENTITY, Quaternion, determinant, orthonormality_error, quaternion_of

MEMBERS = ("center", "size", "rotation", "rotation_quaternion_xyzw", "rotation_quaternion_wxyz", "min", "max", "label",
           "score")  # fmt: skip
OPEN3D = {"extent": "size", "R": "rotation", "min_bound": "min", "max_bound": "max"}
"""Open3D's names for them."""
_OPEN3D_EXTRA = frozenset({"class_name", "color", "version_major", "version_minor"})
"""Members of Open3D's documents that do not describe the box."""

_ORDER = (
    "Give the order of the quaternion in its name: `rotation_quaternion_xyzw` (ROS, SciPy) or "
    "`rotation_quaternion_wxyz` (Eigen's "
    "constructor, nuScenes, COLMAP)."
)
_TURN = "A rotation by the angle a about z is `rotation_quaternion_xyzw`: [0, 0, sin(a/2), cos(a/2)]."
_HALF = "Write `size`: the full edge lengths, twice these."
_EXTENT = "Write `size`: the full edge lengths. They are twice Unity's `extents`."
_ALONG = "Write `size`: [x, y, z], the full edge lengths along the box's own axes."
_CORNERS = "Write the lowest and the highest corner: `min`: [x, y, z] and `max`: [x, y, z]."
INSTEAD = {
    **dict.fromkeys(("quaternion", "rotation_quaternion", "orientation", "quat", "qvec"), _ORDER),
    **dict.fromkeys(("yaw", "heading", "rotation_y", "rotation_z", "angle"), _TURN),
    "euler": "Write `rotation` as a 3x3 matrix: the order of Euler angles is not known.",
    **dict.fromkeys(("half_extents", "half_extent", "half_size"), _HALF),
    **dict.fromkeys(("extents", "m_Extents", "m_Extent"), _EXTENT),
    "dimensions": "The order of dimensions differs between datasets. Write `size`: [x, y, z], the full edge lengths.",
    "wlh": "Write `size`: [x, y, z], the full edge lengths; for nuScenes' boxes that is [length, width, height].",
    **dict.fromkeys(("lwh", "hwl"), _ALONG),
    **dict.fromkeys(("bounds", "bbox", "box", "aabb", "corners", "vertices"), _CORNERS),
    "translation": "Did you mean `center`? A box of nuScenes has `size` [width, length, height] and "
    "`rotation` [w, x, y, z]: write `size`: [length, width, height] and `rotation_quaternion_wxyz`.",
    **{
        name: f"Did you mean `{meant}`?"
        for names, meant in (
            (("lower",), "min"),
            (("upper",), "max"),
            (("position", "location"), "center"),
            (("rotation_matrix",), "rotation"),
            (("class", "name", "category"), "label"),
            (("confidence", "probability"), "score"),
        )
        for name in names
    },
}
"""The correct form for member names that are refused. Most of them are ambiguous."""
FORMS = (
    'Write {"min": [x, y, z], "max": [x, y, z]} or {"center": [x, y, z], "size": [x, y, z], "rotation": [[3], [3], '
    "[3]]}, in the scene's frame and units. docs/api.md lists every form."
)
_NAMED = 'Write {"min": [x, y, z], "max": [x, y, z]} for corners, {"center": [x, y, z], "size": [x, y, z]} otherwise.'
_LEAVE_OUT = "Leave one of the two out."
_MAX_LABEL = 200
_LABEL = re.compile(LABEL_PATTERN)
_MAX_COMPONENT = 1e3
_MAX_ORTHONORMALITY_ERROR = 1e-3
"""Largest entry of |R R^T - I|: matrices written with four digits pass."""
_MIN_NORM = 1e-6
_ROWS = "Write three rows of three numbers; the columns are the box's axes in the scene."
_LISTS = ("detections", "boxes", "objects", "predictions", "results")
_MAX_LISTED = 5

Named = dict[str, tuple[str, Any]]
"""By its member: the name that was written for it, and the value."""


def parse_detection(values: Any, index: int | None = None) -> Detection:
    """The detection from plain (JSON) values. ``index`` selects one if a document has several.

    Raises InvalidDetectionError; its ``place`` tells where in ``values`` the fault is, its ``hint`` what to write.
    """
    values = _chosen(_plain(values), index)
    if isinstance(values, Sequence) and len(values) == 2 and all(isinstance(part, list) for part in values):
        box = _by_corners(values[0], values[1], (0,), (1,), {})
        if all(value > 0 for value in values[1]):
            raise fault((), "is two lists, which may be corners, or a center and a size", _NAMED)
        return box
    if not isinstance(values, Mapping):
        raise fault((), f"is {shown(values)}, expected an object with a box", FORMS)
    found = _members(values)
    corners, rest = found.keys() & {"min", "max"}, found.keys() - {"min", "max", "label", "score"}
    if corners and rest:
        extra = found[min(rest)][0]
        raise fault((extra,), "goes with `center` and `size`, but the box has corners too", "Leave one of them out.")
    required = ("min", "max") if corners else ("center", "size")
    for member in required:
        if member not in found:
            other = next((f": `{found[name][0]}` is there" for name in required if name in found), "")
            raise fault((member,), f"is missing{other}", FORMS)
    (first, one), (second, two) = (found[member] for member in required)
    if second == "extent" and "R" not in values:
        raise fault((second,), "may be full edge lengths (Open3D, with `R`) or half of them (Unity, Unreal)", _EXTENT)
    if corners:
        return _by_corners(one, two, (first,), (second,), found)
    return Detection(point(one, (first,)), edges(two, (second,)), _rotation(found), **_labels(found))


def _plain(value: Any) -> Any:
    """Arrays of NumPy and torch, and tuples, as lists."""
    if isinstance(value, Mapping):
        return {name: _plain(part) for name, part in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


def _members(values: Mapping[Any, Any]) -> Named:
    extra = _OPEN3D_EXTRA if values.keys() & OPEN3D.keys() else frozenset()
    unknown = [name for name in values if name not in MEMBERS and name not in OPEN3D and name not in extra]
    if unknown:
        name = min(unknown, key=lambda name: name not in INSTEAD)  # the one that says what is meant
        hint = INSTEAD.get(name) or suggestion(str(name), MEMBERS) or FORMS
        raise fault((str(name),), "is not a member of a detection", hint)
    found: Named = {}
    for name, value in values.items():
        member = OPEN3D.get(name, name)
        if member in found:
            raise fault((name,), f"is given twice, also as `{found[member][0]}`", _LEAVE_OUT)
        if member in MEMBERS:
            found[member] = name, value
    return found


def _by_corners(low: Any, high: Any, low_place: Place, high_place: Place, found: Named) -> Detection:
    lower, upper = point(low, low_place), point(high, high_place)
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        if a >= b:
            swapped = all(p > q for p, q in zip(lower, upper, strict=True))
            hint = "Check whether min and max are swapped." if swapped else "min is the lowest corner, max the highest."
            raise fault((*high_place, i), f"is {b:g}, expected more than min[{i}], which is {a:g}", hint)
    center = tuple((a + b) / 2 for a, b in zip(lower, upper, strict=True))
    size = tuple(b - a for a, b in zip(lower, upper, strict=True))
    return Detection(center, size, IDENTITY, **_labels(found))  # type: ignore[arg-type]  # of three, as the corners are


def _labels(found: Named) -> dict[str, Any]:
    label, score = (found[name][1] if name in found else None for name in ("label", "score"))
    if label is not None and not (isinstance(label, str) and _LABEL.match(label) and 0 < len(label) <= _MAX_LABEL):
        raise fault(("label",), f"is {shown(label)}, expected 1 to {_MAX_LABEL} printable characters")
    if score is not None and not 0.0 <= number(score, ("score",)) <= 1.0:
        hint = "Divide a percentage by 100." if 1 < score <= 100 else None
        raise fault(("score",), f"is {shown(score)}, expected a number from 0 to 1", hint)
    return {"label": label, "score": None if score is None else float(score)}


def _rotation(found: Named) -> Quaternion:
    """The box's rotation: a 3x3 matrix, or a quaternion that says its order."""
    given = [name for name in MEMBERS if name.startswith("rotation") and name in found]
    if not given:
        return IDENTITY
    written, value = found[given[0]]
    if len(given) > 1:
        raise fault((found[given[1]][0],), f"is given twice, also as `{written}`", _LEAVE_OUT)
    if given[0] != "rotation":
        return _read_quaternion(value, (written,), given[0].removeprefix("rotation_quaternion_"))
    if isinstance(value, Mapping):
        return _read_quaternion(value, (written,), "xyzw")
    return _read_matrix(value, (written,))


def _read_quaternion(value: Any, place: Place, order: str) -> Quaternion:
    """A quaternion whose components come in ``order``, as x, y, z, w."""
    components = dict(zip(order, numbers(value, place, order, _MAX_COMPONENT), strict=True))
    if math.hypot(*components.values()) < _MIN_NORM:
        raise fault(place, "is zero, expected a quaternion with a direction", "Leave it out for an axis-aligned box.")
    return components["x"], components["y"], components["z"], components["w"]


def _read_matrix(value: Any, place: Place) -> Quaternion:
    parts = value if isinstance(value, list) else []
    if len(parts) == 4 and not any(isinstance(part, Sequence) for part in parts):
        listed = ", ".join(f"{number(part, (*place, i), _MAX_COMPONENT):g}" for i, part in enumerate(parts))
        hint = (
            f"Write `rotation_quaternion_xyzw`: [{listed}] if the last number is w, "
            f"`rotation_quaternion_wxyz`: [{listed}] if the first one is."
        )
        raise fault(place, f"is a quaternion of unknown order, [{listed}]", hint)
    if len(parts) != 3 or not all(isinstance(row, Sequence) and len(row) == 3 for row in parts):
        raise fault(place, f"is {shown(value)}, expected a 3x3 matrix", _ROWS)
    rows = [[number(part, (*place, i, j), _MAX_COMPONENT) for j, part in enumerate(row)] for i, row in enumerate(parts)]
    error = orthonormality_error(rows)
    if error > _MAX_ORTHONORMALITY_ERROR:
        hint = "Its rows must be perpendicular and have length 1. Put the scale into `size`, and write more digits."
        raise fault(place, f"is not a rotation: R R^T differs from the identity by {error:.2g}", hint)
    if determinant(rows) < 0:
        hint = "Negate one column. The box stays the same, and its axes become right-handed."
        raise fault(place, "is a reflection, of determinant -1, expected a rotation, of determinant 1", hint)
    identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return IDENTITY if rows == identity else quaternion_of(rows)


# A document with several detections: which one is meant is asked, never guessed.


def _chosen(values: Any, index: int | None) -> Any:
    """The one detection of a document: all of it, or the entry ``index`` of its list. Raises InvalidDetectionError."""
    place: Place = ()
    entries = None
    if isinstance(values, list) and (not values or any(isinstance(one, Mapping) for one in values)):
        entries = values
    for name in _LISTS if isinstance(values, Mapping) else ():
        if entries is None and isinstance(values.get(name), list):
            place, entries = (name,), values[name]
    if entries is None:
        if index is not None:
            raise fault((), f"is a single box, but the index {index} is given", "Leave the index out.")
        return values
    if not entries:
        raise fault(place, "is an empty list, expected a box", FORMS)
    if index is None:
        listed = ", ".join(f"{number}: {_summary(entry)}" for number, entry in enumerate(entries[:_MAX_LISTED]))
        more = f" and {len(entries) - _MAX_LISTED} more" if len(entries) > _MAX_LISTED else ""
        count = "1 detection" if len(entries) == 1 else f"{len(entries)} detections"
        hint = "Give the entry without the list. At the command line, --detection-index selects it."
        raise fault(place, f"is a list of {count}, expected one box", f"{hint} {listed}{more}")
    if not 0 <= index < len(entries):
        raise fault(place, f"has no entry {index}", f"Choose one of 0 to {len(entries) - 1}.")
    return entries[index]


def _summary(entry: Any) -> str:
    if not isinstance(entry, Mapping):
        return shown(entry)
    pairs = (("label", "class", "name"), ("score", "confidence"))
    told = [next((entry[key] for key in keys if key in entry), None) for keys in pairs]
    return " ".join(shown(value) for value in told if isinstance(value, str | int | float)) or "a box"


# Boxes as other libraries have them: read by their attributes, so that none of these is needed here.

_OPEN3D_BOXES = (("center", "extent", "R"), ("min_bound", "max_bound"))


class HasDetection(Protocol):
    """A box of this library."""

    def to_detection(self) -> Detection: ...


class Open3DBox(Protocol):
    """Open3D's OrientedBoundingBox or AxisAlignedBoundingBox."""

    @property
    def color(self) -> Any: ...


BoxLike = HasDetection | Open3DBox | Detection | Mapping[str, Any] | Sequence[Any] | os.PathLike[str]
"""A box, an Open3D box, a detection's JSON in any of its forms or its file's path, or a lowest and a highest corner."""


def detection_of(box: Any) -> Detection:
    """The detection that a box of any kind stands for. Raises InvalidDetectionError with what to write instead."""
    if isinstance(box, Detection):
        return box
    if callable(getattr(box, "to_detection", None)):
        found: Detection = box.to_detection()
        return found
    names = open3d_names(box)
    return parse_detection({name: getattr(box, name) for name in names} if names else box)


def open3d_names(box: Any) -> tuple[str, ...]:
    """The attributes by which Open3D describes a box; none where it is no box of Open3D."""
    known = (names for names in _OPEN3D_BOXES if all(hasattr(box, name) for name in names))
    return () if isinstance(box, Mapping) else next(known, ())
