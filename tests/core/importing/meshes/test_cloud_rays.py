"""What a cloud's rays have seen, against exact answers: a ball over a ground, measured from one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.cloud import convert_cloud
from regnf_core.importing.families.cloud_rays import observed_by_rays
from regnf_core.importing.meshes.triangle_files import Geometry
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.description import FREE, OBSERVATION, SURFACE, UNSEEN, ObservationGrid

Array = NDArray[np.float64]
SENSOR = np.array([1.2, -0.4, 1.5])
RADIUS, GROUND, HALF = 0.4, -1.0, 1.5


def met(start: Array, along: Array) -> Array:
    """How far rays (N, 3) from a place or places (N, 3) go to the ball or the ground; infinity past both."""
    a, b = (along**2).sum(axis=1), (start * along).sum(axis=1)
    root = b**2 - a * ((start**2).sum(axis=-1) - RADIUS**2)
    with np.errstate(all="ignore"):
        ball = np.where(root >= 0.0, (-b - np.sqrt(root)) / a, np.inf)
        ground = (GROUND - start[..., 2]) / along[:, 2]
        place = start + ground[:, None] * along
    ground = np.where((ground > 0.0) & (np.abs(place[:, :2]) <= HALF).all(axis=1), ground, np.inf)
    return np.minimum(np.where(ball > 1e-9, ball, np.inf), ground)


def scan(sensor: Array, count: int = 60_000) -> Array:
    """(N, 3): points that a sensor measures, its rays spread evenly over the sphere."""
    number = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5.0**0.5) * number
    ring = np.sqrt(1.0 - height**2)
    along = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    length = met(sensor, along)
    hit = np.isfinite(length)
    found: Array = sensor + length[hit, None] * along[hit]
    return found


BALL = RADIUS * np.random.default_rng(0).normal(size=(4000, 3))
BALL *= RADIUS / np.linalg.norm(BALL, axis=1, keepdims=True)


def grid_of(points: Array, sensors: Array, spacing: float = 0.02) -> tuple[NDArray[np.uint8], Array, float]:
    """States (V,), middles (V, 3) of the voxels, and their edge."""
    seen = observed_by_rays(points, np.broadcast_to(sensors, points.shape), spacing)
    assert seen is not None
    grid, words = seen
    states = grid.unpack(words)
    middles = np.array(grid.low) + (np.indices(states.shape).reshape(3, -1).T + 0.5) * grid.voxel
    return states.ravel(), middles, grid.voxel


def test_free_is_what_the_sensor_saw_and_nothing_behind_a_surface() -> None:
    points = scan(SENSOR)
    states, middles, voxel = grid_of(points, SENSOR)
    along = middles - SENSOR
    visible = met(SENSOR, along) >= 1.0
    distance = np.minimum(np.abs(np.linalg.norm(middles, axis=1) - RADIUS), np.abs(middles[:, 2] - GROUND))
    free = states == FREE
    assert free.sum() > 10_000
    hidden = free & ~visible  # a ray touches voxels whose middles are beyond an edge of what it passes
    shadow = np.flatnonzero(hidden)
    assert len(shadow) < 0.05 * free.sum()
    within = (np.array(list(np.ndindex(7, 7, 7))) + 0.5) / 7.0 - 0.5
    assert all((met(SENSOR, middle + voxel * within - SENSOR) >= 1.0).any() for middle in middles[shadow])
    inside = (np.linalg.norm(middles, axis=1) < RADIUS - voxel) | (middles[:, 2] < GROUND - voxel)
    assert not free[inside].any()
    beside = np.linalg.norm(middles[:, :2], axis=1) < 0.2
    under = beside & (middles[:, 2] < -RADIUS - voxel) & ~visible & (distance > 2 * voxel)
    assert under.any()
    assert (states[under] == UNSEEN).mean() > 0.9


def test_what_is_seen_is_said_to_be_free_and_points_are_surface() -> None:
    points = scan(SENSOR)
    states, middles, voxel = grid_of(points, SENSOR)
    lengths = np.linalg.norm(middles - SENSOR, axis=1)
    reaching = met(SENSOR, middles - SENSOR)
    before = np.isfinite(reaching) & ((reaching - 1.0) * lengths > 4 * voxel) & (lengths > 2 * voxel)
    clear = np.linalg.norm(middles, axis=1) > RADIUS + 2 * voxel  # not beside the ball's edge
    chosen = before & clear & (middles[:, 2] > GROUND + 2 * voxel) & (np.abs(middles[:, :2]) < 1.4).all(axis=1)
    assert (states[chosen] == FREE).mean() > 0.97
    near = np.array([np.abs(middles - point).max(axis=1).argmin() for point in points[::997]])
    assert (states[near] == SURFACE).all()


def test_each_point_has_its_own_position_and_unknown_ones_say_nothing() -> None:
    other = np.array([-1.3, 0.2, 1.4])
    first, second = scan(SENSOR), scan(other)
    points = np.concatenate([first, second])
    sensors = np.concatenate([np.broadcast_to(SENSOR, first.shape), np.broadcast_to(other, second.shape)])
    both = grid_of(points, sensors)[0]
    half = np.where(np.arange(len(points))[:, None] < len(first), sensors, np.nan)
    one = grid_of(points, half)[0]
    assert (both == FREE).sum() > 1.1 * (one == FREE).sum()
    assert ((one == SURFACE) == (both == SURFACE)).all()
    assert observed_by_rays(points, np.full(points.shape, np.nan), 0.02) is None
    assert observed_by_rays(points + 1e7, sensors + 1e7, 0.02) is None


def test_a_position_that_cannot_be_right_says_nothing() -> None:
    assert observed_by_rays(BALL, np.broadcast_to([0.6, 0.0, 0.0], BALL.shape), 0.02) is None


def observed(points: Array, **said: object) -> tuple[ObservationGrid, NDArray[np.uint8], tuple[str, ...]]:
    geometry = Geometry(points, np.zeros((0, 3), np.int64))
    found = convert_cloud(geometry, "points", UploadDescription.from_dict(said))
    grid = ObservationGrid(**found.description[OBSERVATION])
    return grid, grid.unpack(np.asarray(found.tensors[OBSERVATION])), found.warnings


def test_the_import_option_states_the_position_also_far_from_the_origin() -> None:
    points = scan(SENSOR, 20_000)
    grid, states, warnings = observed(points, sensor=SENSOR.tolist())
    assert (states == FREE).sum() > 1000
    assert "the position of the sensor" in warnings[0]
    shift = np.array([500_000.0, 4_000_000.0, 100.0])
    far, moved, _ = observed(points + shift, sensor=(SENSOR + shift).tolist(), world_scale=2.0)
    assert max(map(abs, far.low)) < 100.0
    np.testing.assert_allclose(far.voxel, grid.voxel, rtol=1e-6)
    assert abs(int((moved == FREE).sum()) - int((states == FREE).sum())) < 0.1 * (states == FREE).sum()


def test_a_position_belongs_to_a_cloud_alone() -> None:
    with pytest.raises(FieldFormatError, match=r"description\.sensor"):
        UploadDescription.from_dict({"sensor": [1, 2]})
    geometry = Geometry(BALL, np.zeros((0, 3), np.int64))
    assert OBSERVATION not in convert_cloud(geometry, "points", UploadDescription()).description
    wrong = replace(geometry, sensor=np.array([0.6, 0.0, 0.0]))
    found = convert_cloud(wrong, "points", UploadDescription())
    assert OBSERVATION not in found.description
    assert found.why[-1].startswith("no observation")
