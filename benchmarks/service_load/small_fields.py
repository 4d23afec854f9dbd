"""A scene and an object that register in a fraction of a second: dense grids of a formula's values, as `.npz` files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from regnf_client import Client
from tests.core.analytic import AnalyticField, chair, chair_box, chair_pose, room

_NODES = 64
EMPTY_BOX = {"min": [0.3, -0.9, 0.5], "max": [0.7, -0.5, 0.8]}
"""A box in the room's free space: a job that fails with NO_SURFACE_IN_DETECTION."""


@dataclass(frozen=True)
class SmallPair:
    """A room with a chair in it and the chair alone; ``detection`` is the chair's box in the room."""

    scene: Path
    object: Path
    detection: dict[str, Any]
    T_object_scene: list[list[float]]

    def upload(self, service: Client) -> dict[str, Any]:
        """Send both and wait for their import; the request that registers them."""
        sent = {"scene": service.upload(self.scene).sha256, "object": service.upload(self.object).sha256}
        return {**sent, "detection": self.detection}


def submit(service: Client, request: dict[str, Any]) -> str:
    """Ask for what ``SmallPair.upload`` made, changed perhaps; the job's id."""
    more = dict(request)
    scene, obj, detection = (more.pop(name) for name in ("scene", "object", "detection"))
    return service.submit(scene, obj, detection, more=more).id


def write_small_pair(folder: Path, factor: float = 1.0) -> SmallPair:
    """Both files, a megabyte each, below ``folder``; the same bytes each time, others with another ``factor``."""
    folder.mkdir(exist_ok=True)
    truth = chair_pose()
    paths = []
    for name, field, reach in (("room", room(truth), 1.0), ("chair", chair(), 0.6)):
        paths.append(folder / f"{name}.npz")
        values = _sampled(field, reach) * np.float32(factor)
        np.savez(paths[-1], sdf=values, bounds=np.array([[-reach] * 3, [reach] * 3]))
    box = chair_box(truth)
    low, high = (box.center - box.size / 2).tolist(), (box.center + box.size / 2).tolist()
    return SmallPair(*paths, {"min": low, "max": high}, truth.matrix().tolist())


def _sampled(field: AnalyticField, reach: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    axis = torch.linspace(-reach, reach, _NODES)
    values: np.ndarray[Any, np.dtype[np.float32]] = field.signed_distance(
        torch.cartesian_prod(axis, axis, axis)
    ).numpy()
    return values.reshape(_NODES, _NODES, _NODES)
