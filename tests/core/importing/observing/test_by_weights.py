"""What a fused map's weights say was observed: against a camera's own lines of sight, and node by node."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import observation_of
from regnf_core.importing.observing.by_weights import observed_by_weights
from regnf_core.schema.description import FREE, OBSERVATION, SURFACE, UNSEEN, ObservationGrid
from regnf_core.schema.safe_format import read_description, write_safe_field
from tests.core.importing.in_process import convert

STEP, TRUNCATION, EDGE = 0.1, 0.2, 4


def ball_seen_from_above(counts: tuple[int, int, int] = (20, 24, 20)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values and weights (X, Y, Z) of a ball that was seen along -z, and the first node's place."""
    origin = np.array([-1.0, -1.1, -0.9])
    points = origin + STEP * np.moveaxis(np.indices(counts), 0, -1)
    values = np.linalg.norm(points, axis=-1) - 0.5
    across = np.hypot(points[..., 0], points[..., 1])
    height = np.sqrt(np.maximum(0.25 - across**2, 0.0))
    seen = (across < 0.5) & (points[..., 2] > height - TRUNCATION) | (across >= 0.55)
    return np.clip(values, -TRUNCATION, TRUNCATION).astype(np.float32), seen.astype(np.float32), origin


def states_of(values: np.ndarray, weights: np.ndarray, origin: np.ndarray, blocks: bool) -> tuple[Any, Any]:
    description: dict[str, Any] = {"origin": origin.tolist(), "sign": 1}
    if not blocks:
        tensors = {"values": values, "weights": weights}
        return observed_by_weights({**description, "kind": "voxel_grid", "spacing": [STEP] * 3}, tensors)
    shape = [length // EDGE for length in values.shape]
    index = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    kept = np.random.default_rng(0).permutation(len(index))
    parts = [
        np.stack([array[tuple(slice(EDGE * at, EDGE * at + EDGE) for at in block)] for block in index[kept]])
        for array in (values, weights)
    ]
    tensors = {"values": parts[0], "weights": parts[1], "blocks": index[kept].astype(np.int32)}
    return observed_by_weights({**description, "kind": "voxel_blocks", "voxel_size": STEP}, tensors)


def slowly(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Each cell's state by its eight corners, one after the other."""
    cells = np.zeros([length - 1 for length in values.shape], np.uint8)
    for cell in np.ndindex(cells.shape):
        corners = [tuple(np.add(cell, offset)) for offset in np.ndindex(2, 2, 2)]
        if all(weights[corner] > 0 for corner in corners):
            inside = [values[corner] < 0 for corner in corners]
            cells[cell] = UNSEEN if all(inside) else SURFACE if any(inside) else FREE
    return cells


def test_a_voxel_holds_what_its_cells_are() -> None:
    values, weights, origin = ball_seen_from_above()
    grid, words = states_of(values, weights, origin, blocks=False)
    states, cells = grid.unpack(words), slowly(values, weights)
    assert np.isclose(grid.voxel, 2 * STEP)
    assert np.allclose(grid.low, origin)
    for voxel in np.ndindex(states.shape):
        part = cells[tuple(slice(2 * at, 2 * at + 2) for at in voxel)]
        expected = SURFACE if (part == SURFACE).any() else FREE if 2 * (part == FREE).sum() >= part.size else UNSEEN
        assert states[voxel] == expected
    assert {FREE, SURFACE, UNSEEN} == set(states.ravel().tolist())


def test_blocks_in_any_order_observe_what_one_grid_does() -> None:
    grid, words = states_of(*ball_seen_from_above(), blocks=False)
    other, others = states_of(*ball_seen_from_above(), blocks=True)
    assert np.array_equal(grid.unpack(words), other.unpack(others))
    assert np.allclose(grid.low, other.low)


def test_a_grid_with_weights_is_imported_with_its_observation(tmp_path: Path) -> None:
    values, weights, origin = ball_seen_from_above()
    np.savez(tmp_path / "map.npz", sdf=values, weight=weights, origin=origin, spacing=np.full(3, STEP))
    report = convert(tmp_path / "map.npz", tmp_path / "out", {"world_scale": 2.0})
    assert any(why.startswith("observed by the weights of the map") for why in report["why"])
    observation = observation_of(open_field(tmp_path / "out" / "field.safetensors"))
    assert observation is not None
    at = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.4, 1.4, 0.0], [0.0, 0.0, 0.0]])
    assert observation.at(at).tolist() == [SURFACE, UNSEEN, FREE, UNSEEN]


def test_without_weights_and_far_from_the_origin_there_is_no_observation(tmp_path: Path) -> None:
    values, weights, origin = ball_seen_from_above()
    np.savez(tmp_path / "map.npz", sdf=values, origin=origin, spacing=np.full(3, STEP))
    convert(tmp_path / "map.npz", tmp_path / "out")
    assert observation_of(open_field(tmp_path / "out" / "field.safetensors")) is None
    assert states_of(values, weights, np.full(3, 2e6), blocks=False) is None


def test_an_observation_that_a_file_has_stays_when_it_is_imported_again(tmp_path: Path) -> None:
    values, weights, origin = ball_seen_from_above()
    np.savez(tmp_path / "map.npz", sdf=values, weight=weights, origin=origin, spacing=STEP)
    convert(tmp_path / "map.npz", tmp_path / "first", {"accept_implausible": True})
    first = tmp_path / "first" / "field.safetensors"
    description = read_description(first)
    grid = ObservationGrid((-0.5, -0.5, -0.5), 0.25, (4, 4, 4))
    states = np.full((4, 4, 4), FREE, np.uint8)
    tensors = {**load_file(first), OBSERVATION: grid.pack(states)}
    write_safe_field(tmp_path / "told.safetensors", {**description, OBSERVATION: asdict(grid)}, tensors)
    convert(tmp_path / "told.safetensors", tmp_path / "second", {"accept_implausible": True})
    seen = observation_of(open_field(tmp_path / "second" / "field.safetensors"))
    assert seen is not None
    assert seen.states.shape == (4, 4, 4)
    assert (seen.states == FREE).all()
