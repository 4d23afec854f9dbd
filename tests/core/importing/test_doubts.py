"""Files whose numbers contradict what their headers say of them: each is taken with a warning, or refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.misread import run
from benchmarks.misread_files import MAKERS, MESHES, npz, twin_of
from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.euclidean import doubts_of_map
from regnf_core.importing.meshes import read_mesh
from tests.core.importing import twins
from tests.core.importing.archives import saved
from tests.core.importing.in_process import convert
from tests.core.importing.twins import PLAIN, Array


def words(report: dict[str, Any]) -> set[str]:
    return {warning.partition(":")[0] for warning in report["warnings"]}


def grid(**changes: Any) -> dict[str, Any]:
    return twins.grid_arrays(PLAIN) | changes


VALUES = grid()["sdf"]


@pytest.mark.parametrize(
    "arrays",
    [
        grid(sdf=VALUES[::2, ::2, ::2]),
        grid(sdf=VALUES * np.float32(1.2)),
        grid(sdf=np.where(VALUES < 0, np.float32(-0.05), np.float32(0.05))),
        grid(sdf=VALUES.ravel(order="F").reshape(VALUES.shape)),
        grid(spacing=grid()["spacing"] * 0.9),
    ],
    ids=["every second node", "another unit", "two values", "Fortran's order", "another spacing"],
)
def test_a_grid_of_no_distances_is_warned_of(arrays: dict[str, Any], tmp_path: Path) -> None:
    assert words(convert(saved(tmp_path, npz(arrays)), tmp_path / "out")) == {"GRADIENT_NOT_UNIT"}


def test_no_right_grid_is_warned_of(tmp_path: Path) -> None:
    for number in range(4):
        data = npz(twins.grid_arrays(twin_of(number), 0.1))
        assert words(convert(saved(tmp_path, data), tmp_path / str(number))) == set()


BLOCKS = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
SIZE = 0.05


def block_values(keys: Array, center: Any = 0.1, radius: float = 0.3) -> Any:
    voxels = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1)
    places = SIZE * (8 * keys[:, None, None, None] + voxels)
    return np.clip(np.linalg.norm(places - center, axis=-1) - radius, -0.2, 0.2).astype(np.float32)


@pytest.mark.parametrize(
    ("turned", "keys", "factor", "wanted"),
    [
        (False, BLOCKS, 1.0, []),
        (False, BLOCKS, 2.0, []),
        (True, BLOCKS, 1.0, ["AXES_UNCERTAIN"]),
        (False, BLOCKS * (-1, 1, 1), 1.0, ["AXES_UNCERTAIN"]),
        (False, BLOCKS * 8, 1.0, ["AXES_UNCERTAIN"]),
        (False, BLOCKS, 10.0, ["GRADIENT_NOT_UNIT"]),
        (False, BLOCKS, 0.1, ["GRADIENT_NOT_UNIT"]),
    ],
    ids=["right", "projective", "x fastest", "mirrored keys", "keys of voxels", "larger", "smaller"],
)
def test_blocks_that_do_not_fit_together(turned: bool, keys: Any, factor: float, wanted: list[str]) -> None:
    """A ball beside the origin. Distances along rays are up to twice too long: no doubt of that."""
    values = np.float32(factor) * block_values(BLOCKS)
    values = np.ascontiguousarray(values.transpose(0, 2, 1, 3)[:, ::-1]) if turned else values
    found = doubts_of_map(values, np.ones(values.shape, bool), keys, SIZE)
    assert [one.partition(":")[0] for one in found] == wanted


def test_two_layers_of_blocks_that_were_swapped() -> None:
    """Their outer faces, which come together, are both in free space: but the surface now ends where the blocks do."""
    keys = BLOCKS[BLOCKS[:, 0] < 1]
    values = block_values(keys, np.array([0.0, 0.1, 0.1]), 0.25)
    found = [doubts_of_map(values, np.ones(values.shape, bool), keys * (sign, 1, 1), SIZE) for sign in (1, -1)]
    assert [[one.partition(":")[0] for one in each] for each in found] == [[], ["AXES_UNCERTAIN"]]


def test_a_gltf_file_whose_numbers_are_not_in_their_stated_range() -> None:
    places, faces = np.asarray(PLAIN.mesh.vertices), np.asarray(PLAIN.mesh.faces)
    assert read_mesh("glb", memoryview(MESHES["glb"](places, faces, ""))).not_applied == ()
    found = read_mesh("glb", memoryview(MESHES["glb"](places, faces, "shifted by a number"))).not_applied
    assert found == ("the min and max of POSITION, which contradict its numbers",)


@pytest.mark.parametrize("line", ["12,5 7,25 -3,0", "12,5;7,25;-3,0", "1 12,5\t7,25 3,5"])
def test_decimal_commas_are_refused_by_name(line: str) -> None:
    data = memoryview(f"{line}\n".encode() * 200)
    with pytest.raises(FieldFormatError, match="decimal points"):
        read_mesh("xyz", data)


@pytest.mark.parametrize("line", ["12,7,3", "1.5,7.25,3.0", "12, 7, 3", "12;7;3"])
def test_commas_between_numbers_are_read(line: str) -> None:
    assert read_mesh("xyz", memoryview(f"{line}\n".encode() * 3)).vertices.shape == (3, 3)


def test_of_some_plausible_but_wrong_files_none_is_taken_without_a_word() -> None:
    endings = [run(number, 3, None) for number in range(60)]
    assert {ending[2] for ending in endings} <= {"refused", "said", "harmless"}
    assert {ending[0] for ending in endings} & set(MAKERS)
