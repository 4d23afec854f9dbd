"""A solid, its mirror image and its images with other axes, through every reader that states or assumes axes.

The field's values have to be those of the twin that was written, and never those of another one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.field_source import find_source
from regnf_core.fields.build import open_field
from regnf_core.importing.assumptions import AXES, GLTF, GRID, METERS, NORMALS, SIGN, SUBJECTS, UNIT
from regnf_core.importing.gate.convert import FIELD_NAME
from regnf_core.loading import safe_field
from tests.core.importing import small_families as small
from tests.core.importing import twins
from tests.core.importing.archives import saved
from tests.core.importing.in_process import convert
from tests.core.importing.test_families import NEUS_SAID
from tests.core.importing.twins import BY_HAND, MARKS, PLAIN, SWAPPED, TWINS, WRITERS, Array

CLOUD_TWINS = ("plain", "mirrored")
CASES = [(kind, name) for kind in WRITERS for name in (CLOUD_TWINS if kind.endswith("cloud") else TWINS)]
MOST, CUT = 0.03, 0.2
"""How far a value may be off, for cells of 0.05 and 2,000 points; where maps cut distances off."""
XYZ = "order: columns 1 to 3 are x, y, z, columns 4 to 6 are normals, as their length is 1"
ASSUMED = {
    "grid": (UNIT, AXES, SIGN, GRID),
    "voxel blocks": (UNIT, AXES, SIGN),
    "nvblox": (METERS, AXES, SIGN),
    **dict.fromkeys(("ply", "obj", "stl"), (UNIT, AXES)),
    "glb": GLTF,
    "ply cloud": (UNIT, AXES, NORMALS),
    "pcd cloud": (UNIT, AXES, NORMALS),
    "xyz cloud": (UNIT, AXES, NORMALS, XYZ),
    "las cloud": ("unit: that of the file's coordinate system, which is not read", AXES),
}


def values(folder: Path, places: Array) -> Array:
    field = open_field(folder / FIELD_NAME)
    return np.asarray(field.signed_distance(torch.from_numpy(places).float()).double().numpy())


def test_the_marks_tell_the_twins_apart() -> None:
    np.testing.assert_allclose(PLAIN.distance(MARKS), BY_HAND, rtol=0, atol=1e-12)
    assert PLAIN.mesh.is_watertight
    for name, twin in TWINS.items():
        np.testing.assert_allclose(twin.distance(twin.at(MARKS)), BY_HAND, rtol=0, atol=1e-12)
        others = [other for key, other in TWINS.items() if key != name]
        assert all(np.abs(other.distance(twin.at(MARKS)) - BY_HAND).max() > 4 * MOST for other in others)


@pytest.mark.parametrize(("kind", "name"), CASES)
def test_the_twin_that_was_written_is_the_one_that_is_read(kind: str, name: str, tmp_path: Path) -> None:
    twin = TWINS[name]
    report = convert(saved(tmp_path, WRITERS[kind](twin)), tmp_path / "out")
    found = values(tmp_path / "out", twin.at(MARKS))
    most = CUT if kind in ("voxel blocks", "nvblox") else 1.0
    np.testing.assert_allclose(np.minimum(found, most), np.minimum(BY_HAND, most), rtol=0, atol=MOST)
    assert tuple(report["assumed"]) == ASSUMED[kind]
    assert not {one.partition(":")[0] for one in report["warnings"]} & {"AXES_UNCERTAIN", "MESH_INSIDE_OUT"}
    assert safe_field(find_source(tmp_path / "out" / FIELD_NAME)).notes.assumed == ASSUMED[kind]
    again = convert(tmp_path / "out" / FIELD_NAME, tmp_path / "again")
    assert tuple(again["assumed"]) == ASSUMED[kind]


def test_a_grid_with_z_first_is_the_mirrored_solid_and_says_so(tmp_path: Path) -> None:
    arrays = twins.grid_arrays(PLAIN)
    low = arrays["origin"]
    turned = arrays | {"sdf": arrays["sdf"].transpose(2, 1, 0), "origin": low[::-1].copy()}
    np.savez(tmp_path / "grid.npz", **turned)
    report = convert(tmp_path / "grid.npz", tmp_path / "out")
    np.testing.assert_allclose(values(tmp_path / "out", SWAPPED.at(MARKS)), BY_HAND, rtol=0, atol=MOST)
    assert GRID in report["assumed"]


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (1, 2, 0)])
def test_a_spacing_that_fits_another_order_of_axes_is_warned_of(order: tuple[int, ...], tmp_path: Path) -> None:
    axes = [np.arange(-0.5, 1.5, step) for step in (0.05, 0.08, 0.11)]
    distance = PLAIN.distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    named = {"origin": np.full(3, -0.5), "spacing": np.array([0.05, 0.08, 0.11])}
    for name, array in (("right", distance), ("wrong", distance.transpose(order))):
        np.savez(tmp_path / f"{name}.npz", sdf=array.astype(np.float32), **named)
    assert convert(tmp_path / "right.npz", tmp_path / "1")["warnings"] == []
    warning, *_ = convert(tmp_path / "wrong.npz", tmp_path / "2")["warnings"]
    assert warning.startswith(f"AXES_UNCERTAIN: the distances fit the spacing better if the array's axes are "
                              f"{', '.join('xyz'[axis] for axis in order)};")  # fmt: skip


def test_what_is_said_is_not_assumed(tmp_path: Path) -> None:
    grid = saved(tmp_path, WRITERS["grid"](PLAIN))
    report = convert(grid, tmp_path / "out", {"sign": 1, "world_scale": 0.001})
    assert tuple(report["assumed"]) == (AXES, GRID)
    assert {line.partition(":")[0] for lines in ASSUMED.values() for line in lines} <= set(SUBJECTS)


@pytest.mark.parametrize("M", [np.eye(3), np.eye(3)[[1, 2, 0]]], ids=["plain", "turned"])
def test_a_network_in_the_frame_of_its_dataset(M: Array, tmp_path: Path) -> None:
    """x_dataset = 2 M x + (1, 2, 3): the distance there is twice the network's."""
    sample = small.neus()
    torch.save(sample.checkpoint, tmp_path / "neus.pth")
    rows = np.block([[2.0 * M, np.array([[1.0], [2.0], [3.0]])], [np.array([[0.0, 0.0, 0.0, 1.0]])]]).tolist()
    said: dict[str, Any] = NEUS_SAID | {"frame": "dataset", "dataset_transform": rows, "accept_implausible": True}
    report = convert(tmp_path / "neus.pth", tmp_path / "out", said)
    points = np.array([[0.3, -0.2, 0.5], [-0.6, 0.1, 0.2]])
    wanted = [2.0 * sample.function(point) for point in points]
    found = values(tmp_path / "out", 2.0 * points @ M.T + (1.0, 2.0, 3.0))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)
    assert tuple(report["assumed"]) == (UNIT, AXES, SIGN)
