"""The fields that the guard times: the demo's, the same at full size, and its room as a grid of distances."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch

from benchmarks.enlarge import enlarge
from benchmarks.guard.cases import FULL_SIZE, GRID, OBJECT, ROOM
from regnf_core import open_field
from regnf_core.schema.safe_format import write_safe_field

DEMO = Path(__file__).parents[2] / "examples" / "data"
_NODES = 96


def make_fields(folder: Path) -> None:
    """Write all fields and boxes into the folder."""
    for path in (*DEMO.glob("*.safetensors"), *DEMO.glob("detection*.json")):
        shutil.copy(path, folder)
    for name in (ROOM, OBJECT):
        enlarge(folder / f"{name}.safetensors", folder / f"{name}{FULL_SIZE}.safetensors")
    write_grid(folder / f"{ROOM}.safetensors", folder / f"{ROOM}{GRID}.safetensors")


def write_grid(source: Path, target: Path, nodes: int = _NODES) -> None:
    """The field of ``source`` at the nodes of a regular grid, ``nodes`` along each axis."""
    field = open_field(source)
    low, high = field.bounds
    axes = [torch.linspace(float(a), float(b), nodes) for a, b in zip(low, high, strict=True)]
    values = field.signed_distance(torch.cartesian_prod(*axes)).reshape(nodes, nodes, nodes)
    description = {
        "kind": "voxel_grid",
        "origin": low.tolist(),
        "spacing": ((high - low) / (nodes - 1)).tolist(),
        "bounds": field.bounds.tolist(),
    }
    write_safe_field(target, description, {"values": values.numpy()})
