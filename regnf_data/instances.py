"""The things that a dataset names: their boxes and poses, in JSON and out of it."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.errors import DatasetError, InvalidDetectionError
from regnf_core.geometry.box import OrientedBox
from regnf_data.layouts import array, matrix4, similarity
from regnf_data.posed_images import Instance

_REASON = "DATASET_INSTANCE_INVALID"
_LABELS = ("label", "name", "id", "class", "class_name")
_LONGEST_LABEL = 200
_CORNER_TOLERANCE = 1e-3
"""Of a box's corners, as a share of its diagonal."""


def read_instances(given: Any) -> tuple[Instance, ...]:
    """The instances of a list, or of an object that names them by its keys; None is none.

    Raises DatasetError (DATASET_INSTANCE_INVALID).
    """
    if not isinstance(given, dict | list | None):
        raise DatasetError("instances are neither a list nor an object", reason=_REASON)
    named = given.items() if isinstance(given, dict) else ((None, entry) for entry in given or ())
    return tuple(_read(entry, name) for name, entry in named)


def write_instance(instance: Instance) -> dict[str, Any]:
    """One instance as the metadata holds it. ``box_min`` and ``box_max`` bound the corners along the world's axes."""
    box = instance.box
    corners = box.corners().numpy()
    written: dict[str, Any] = {
        "label": instance.label,
        "box_min": corners.min(axis=0).tolist(),
        "box_max": corners.max(axis=0).tolist(),
        "box_corners": corners.tolist(),
        # The three above lose the last digits, and the box's own axes; this is what regnf reads back.
        "box": {"center": box.center.tolist(), "size": box.size.tolist(), "rotation": box.rotation.tolist()},
    }
    matrices = {name: getattr(instance, name) for name in ("T_object_world", "world_pose", "gt_pose")}
    return written | {name: np.asarray(T).tolist() for name, T in matrices.items() if T is not None}


def _box_of_corners(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Center (3,), edge lengths (3,) and axes (3, 3), as columns, of the box whose corners (8, 3) come in any order."""
    offsets = corners[1:] - corners[0]
    lengths = np.linalg.norm(offsets, axis=1)
    diagonal = offsets[lengths.argmax()]
    allowed = _CORNER_TOLERANCE * float(np.linalg.norm(diagonal))
    for chosen in combinations(range(7), 3):
        edges, size = offsets[list(chosen)], lengths[list(chosen)]
        if size.min() <= 0.0 or np.abs(edges.sum(axis=0) - diagonal).max() > allowed:
            continue
        axes = (edges / size[:, None]).T
        if np.abs(axes.T @ axes - np.eye(3)).max() <= _CORNER_TOLERANCE:
            if np.linalg.det(axes) < 0.0:
                axes = axes[:, ::-1]
                size = size[::-1]
            left, _, right = np.linalg.svd(axes)
            return corners.mean(axis=0), size, left @ right
    raise DatasetError("box_corners are not the eight corners of a box", reason=_REASON)


def _read(entry: Any, name: str | None) -> Instance:
    if not isinstance(entry, dict):
        raise DatasetError("an instance is not a JSON object", reason=_REASON)
    label = str(next((entry[key] for key in _LABELS if entry.get(key) is not None), name or "instance"))
    label = "".join(letter if letter.isprintable() else "?" for letter in label[:_LONGEST_LABEL])
    read = {"T_object_world": similarity, "world_pose": matrix4, "gt_pose": matrix4}
    known = {k: of(entry[k], f"{k} of {label}", _REASON) for k, of in read.items() if entry.get(k) is not None}
    return Instance(label, _box(entry, label), **known)


def _box(entry: dict[str, Any], label: str) -> OrientedBox:
    """What says most about the box comes first: box, box_corners, box_min with box_max."""
    try:
        if isinstance(entry.get("box"), dict):
            shapes = {"center": (3,), "size": (3,), "rotation": (3, 3)}
            parts = [array(entry["box"].get(k), (s,), f"box {k} of {label}", _REASON) for k, s in shapes.items()]
        elif entry.get("box_corners") is not None:
            corners = array(entry["box_corners"], ((8, 3),), f"box_corners of {label}", _REASON)
            parts = list(_box_of_corners(corners))
            if np.allclose(np.abs(parts[2]).max(axis=0), 1.0, atol=1e-6):
                return OrientedBox.from_corners(corners.min(axis=0), corners.max(axis=0), label)
        else:
            lower, upper = (array(entry.get(k), ((3,),), f"{k} of {label}", _REASON) for k in ("box_min", "box_max"))
            return OrientedBox.from_corners(lower, upper, label)
        center, size, rotation = (torch.tensor(np.ascontiguousarray(part)) for part in parts)
        return OrientedBox(center, size, rotation, label)
    except InvalidDetectionError as error:
        raise DatasetError(f"the box of {label}: {error}", reason=_REASON) from error
