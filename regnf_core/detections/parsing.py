"""One parser for every form of a detection: of the command line, of Python and of the HTTP interface.

    {"min": [..], "max": [..]} · [[min], [max]]              an axis-aligned box
    {"center": [..], "size": [..]}                           the same by its center and full edge lengths
     + "rotation": 3x3 | {"x":, "y":, "z":, "w":}            box axes to scene axes
     + "rotation_quaternion_xyzw" | "rotation_quaternion_wxyz"
    {"center": .., "extent": .., "R": ..}                    Open3D's OrientedBoundingBox
    {"min_bound": .., "max_bound": ..}                       Open3D's AxisAlignedBoundingBox
    {"translation": .., "size": .., "rotation": ..}          nuScenes

What does not say enough is refused: a bare list of four numbers as `rotation` may have either order. nuScenes' form is
known by its three names; its size is width, length, height (the length lies along the box's x, the width along y, the
height along z) and its rotation is w, x, y, z.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from regnf_core.detections.detection import Detection
from regnf_core.detections.names import (
    CANONICAL,
    FORMS,
    INSTEAD,
    NUSCENES_EXTRA,
    NUSCENES_LABELS,
    NUSCENES_NAMES,
    NUSCENES_SCORES,
    OPEN3D_EXTRA,
    OPEN3D_NAMES,
    ROTATIONS,
)
from regnf_core.detections.numbers import Place, edges, fault, number, point, shown
from regnf_core.detections.rotation_forms import read_quaternion, read_rotation
from regnf_core.detections.several import chosen
from regnf_core.hints import suggestion
from regnf_core.labels import LABEL_PATTERN
from regnf_core.rotations import IDENTITY, Quaternion

_MAX_LABEL = 200
_LABEL = re.compile(LABEL_PATTERN)
_LABELED = frozenset({"label", "score"})


def parse_detection(values: Any, index: int | None = None) -> Detection:
    """The detection that plain (JSON) values say. ``index`` chooses one where a document holds several.

    Raises InvalidDetectionError; its ``place`` tells where in ``values`` the fault is, its ``hint`` what to write.
    """
    values = chosen(_plain(values), index)
    if _is_pair_of_corners(values):
        return _by_corners(values[0], values[1], (0,), (1,), {})
    if not isinstance(values, Mapping):
        raise fault((), f"is {shown(values)}, expected an object with a box", FORMS)
    if values.keys() >= NUSCENES_NAMES:
        return _nuscenes(values)
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
    for name, value in values.items():
        member = CANONICAL.get(name)
        if member is None and name not in extra:
            raise fault((str(name),), "is not a member of a detection", INSTEAD.get(name) or _meant(name))
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


def _nuscenes(values: Mapping[Any, Any]) -> Detection:
    known = NUSCENES_NAMES | NUSCENES_EXTRA | _LABELED | {*NUSCENES_LABELS, *NUSCENES_SCORES}
    for name in values:
        if name not in known:
            raise fault((str(name),), "is not a member of a nuScenes box", suggestion(str(name), known) or FORMS)
    width, length, height = edges(values["size"], ("size",))
    label = next((values[name] for name in ("label", *NUSCENES_LABELS) if name in values), None)
    score = next((values[name] for name in NUSCENES_SCORES if name in values), None)
    return Detection(
        point(values["translation"], ("translation",)),
        (length, width, height),
        read_quaternion(values["rotation"], ("rotation",), "wxyz"),
        **_labels({"label": label, "score": values.get("score", None if score == -1 else score)}),
    )


def _labels(found: Mapping[str, Any]) -> dict[str, Any]:
    label, score = found.get("label"), found.get("score")
    if label is not None and not (isinstance(label, str) and _LABEL.match(label) and 0 < len(label) <= _MAX_LABEL):
        raise fault(("label",), f"is {shown(label)}, expected 1 to {_MAX_LABEL} printable characters")
    if score is not None and not 0.0 <= number(score, ("score",)) <= 1.0:
        hint = "Divide a percentage by 100." if 1 < score <= 100 else None
        raise fault(("score",), f"is {shown(score)}, expected a number from 0 to 1", hint)
    return {"label": label, "score": None if score is None else float(score)}
