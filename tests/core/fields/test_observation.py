"""What a field rests on: stored and read back, and asked for in any frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import ScaledField, open_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import CountingField, Observation, ObservedField, observation_of
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.description import FREE, SURFACE, UNSEEN, ObservationGrid
from regnf_core.schema.safe_format import read_description, write_safe_field
from tests.core.analytic import sphere
from tests.core.fields.small_field import description, tensors

GRID = ObservationGrid((-1.0, -2.0, 0.0), 0.5, (3, 2, 4))


def some_states() -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(0).integers(0, 3, GRID.counts).astype(np.uint8)


def some_observation() -> Observation:
    return Observation(torch.from_numpy(some_states()), torch.tensor(GRID.low, dtype=torch.float64), GRID.voxel)


def test_states_are_packed_as_documented() -> None:
    states = some_states()
    words = GRID.pack(states)
    assert words.dtype == np.int32
    assert words.shape == (2,)  # 24 voxels, 16 to a number
    for index, state in enumerate(states.ravel()):
        assert (int(words[index // 16]) >> (2 * (index % 16))) & 3 == state
    np.testing.assert_array_equal(GRID.unpack(words), states)
    assert (GRID.unpack(np.full(2, -1, np.int32)) == SURFACE).all()  # the fourth state


def test_states_by_place() -> None:
    observation = some_observation()
    # The voxel (2, 1, 3) reaches from (0, -1.5, 1.5) to (0.5, -1, 2).
    points = torch.tensor([[0.01, -1.49, 1.51], [0.49, -1.01, 1.99], [0.51, -1.2, 1.7], [0.2, -1.2, -0.01]])
    state = int(some_states()[2, 1, 3])
    assert observation.at(points).tolist() == [state, state, UNSEEN, UNSEEN]


def test_the_extent_of_what_was_measured_in_any_frame() -> None:
    states = torch.zeros(GRID.counts, dtype=torch.uint8)
    low = torch.tensor(GRID.low, dtype=torch.float64)
    assert Observation(states, low, GRID.voxel).measured_extent() is None
    states[1, 0, 2] = states[2, 1, 2] = SURFACE
    states[0, 0, 0] = FREE
    observation = Observation(states, low, GRID.voxel)
    # Voxels from (-0.5, -2, 1) to (0, -1.5, 1.5), and from (0, -1.5, 1) to (0.5, -1, 1.5).
    expected = torch.tensor([[-0.5, -2.0, 1.0], [0.5, -1.0, 1.5]], dtype=torch.float64)
    torch.testing.assert_close(observation.measured_extent(), expected)
    # A quarter turn about z, (x, y) to (-y, x), twice the size, and a shift along x.
    turn = torch.tensor([[0.0, -2.0, 0.0, 3.0], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    turned = observation.seen_in(Sim3.from_matrix(turn.double()).inverse())
    expected = torch.tensor([[5.0, -1.0, 2.0], [7.0, 1.0, 3.0]], dtype=torch.float64)
    torch.testing.assert_close(turned.measured_extent(), expected)


def test_every_frame_sees_the_same() -> None:
    field = ObservedField(sphere(0.5), some_observation())
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 3.0 - 1.5
    there = some_observation().at(points)
    assert {UNSEEN, FREE, SURFACE} == set(there.tolist())
    T = Sim3.from_quaternion(2.0, [0.5, 0.1, -0.3, 0.8], [0.3, -0.2, 0.1])
    seen = observation_of(TransformedField(TransformedField(CountingField(field), T), T))
    assert seen is not None
    assert (seen.at((T @ T).inverse().apply(points)) == there).all()
    larger = observation_of(ScaledField(field, scale=4.0))
    assert larger is not None
    assert (larger.at(4.0 * points) == there).all()
    assert observation_of(TransformedField(sphere(0.5), T)) is None
    assert observation_of(CountingField(sphere(0.5))) is None


def test_a_file_keeps_it(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    grid, words = some_observation().stored()
    told = {"low": grid.low, "voxel": grid.voxel, "counts": grid.counts}
    write_safe_field(path, description(observation=told, world_scale=2.0), {**tensors(), "observation": words})
    assert read_description(path)["observation"]["counts"] == [3, 2, 4]
    seen = observation_of(open_field(path))
    assert seen is not None
    centers = torch.cartesian_prod(*(torch.arange(n) + 0.5 for n in GRID.counts)) * GRID.voxel + torch.tensor(GRID.low)
    # The grid is told in the function's coordinates; the field's are twice as large.
    np.testing.assert_array_equal(seen.at(2.0 * centers).numpy(), some_states().ravel())


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"counts": (3, 2, 4)}, np.zeros(1, np.int32)),
        ({"counts": (3, 2, 4)}, np.zeros(2, np.float32)),
        ({"counts": (3, 2, 4)}, None),
        ({"counts": (3, 2, 0)}, np.zeros(2, np.int32)),
        ({"counts": (3, 2, 100_000)}, np.zeros(37_500, np.int32)),
        ({"counts": (3, 2, 4), "voxel": 0.0}, np.zeros(2, np.int32)),
        ({"counts": (3, 2, 4), "low": (0.0, float("nan"), 0.0)}, np.zeros(2, np.int32)),
        (None, np.zeros(2, np.int32)),
    ],
)
def test_what_does_not_fit_is_refused(
    tmp_path: Path, told: dict[str, object] | None, words: np.ndarray[tuple[int, ...], np.dtype[np.generic]] | None
) -> None:
    values = description() if told is None else description(observation={"low": (0, 0, 0), "voxel": 1.0, **told})
    stored = tensors() if words is None else {**tensors(), "observation": words}
    with pytest.raises(FieldFormatError) as caught:
        write_safe_field(tmp_path / "field.safetensors", values, stored)
    assert caught.value.reason in {"FIELD_SHAPES_MISMATCH", "SAFE_FORMAT_INVALID"}
    assert list(tmp_path.iterdir()) == []
