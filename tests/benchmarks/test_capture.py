"""What sensors read of a world, and that the truth puts an object where it was measured."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.random_worlds.fusing import (
    BLACK,
    PLAIN,
    Capture,
    Fusion,
    RandomSensor,
    capture,
    draw_sensor,
    fuse,
    rendered_sensor,
)
from benchmarks.random_worlds.mesh import Array, ExactScene, ExactView, ball, box, turned
from benchmarks.random_worlds.models import Model
from benchmarks.random_worlds.symmetries import measure_symmetries
from benchmarks.worlds.rendering import DepthSensor
from benchmarks.worlds.trajectories import look_at
from regnf_core.fields.build import open_field

SIZE = (60, 80)
EXACT = RandomSensor(
    "time of flight", SIZE, 60.0, 0.1, 5.0, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, grazing_deg=89.0
)
BALL = ball((0.0, 0.0, 0.3), 0.3, 40)
SHEET_UP = np.array([[0, 1, 2], [0, 2, 3]])
FLOOR = box((-1.0, -1.0, -0.1), (1.0, 1.0, 0.0))


def ring(count: int = 10) -> Array:
    angles = 2.0 * np.pi * np.arange(count) / count
    positions = np.stack([1.5 * np.cos(angles), 1.5 * np.sin(angles), np.full(count, 0.9)], axis=1)
    return look_at(positions, np.tile((0.0, 0.0, 0.3), (count, 1)))


def taken(errors: Array | None = None) -> Capture:
    poses = ring()
    points, normals = BALL.sample(300, np.random.default_rng(0))
    errors = np.tile(np.eye(4), (len(poses), 1, 1)) if errors is None else errors
    matter = np.full(2, PLAIN)
    groups = [(1, points, normals)]
    return capture(ExactScene([FLOOR, BALL]), EXACT, poses, errors, groups, matter, np.random.default_rng(0))


@cache
def undisturbed() -> Capture:
    return taken()


def plane(depth: float, count: int = 200) -> ExactView:
    shape = (count, count)
    return ExactView(np.full(shape, depth), np.zeros(shape, np.int64), np.full(shape, 0.99))


@pytest.mark.parametrize("depth", [0.8, 2.5])
def test_readings_err_as_much_as_the_sensor_says(depth: float) -> None:
    for seed in range(6):
        sensor = replace(draw_sensor(np.random.default_rng(seed)), step=0.0, farthest_m=5.0)
        errors = sensor.measure(plane(depth), np.array([PLAIN]), np.random.default_rng(1)) - depth
        assert errors.std() == pytest.approx(float(sensor.deviation_m(np.array(depth))), rel=0.25)
        assert abs(errors.mean()) < 0.3 * errors.std()


def test_a_simulated_datasets_camera_is_exact_or_errs_as_its_depth_sensor() -> None:
    drawn = [rendered_sensor(np.random.default_rng(seed)) for seed in range(12)]
    depth = np.linspace(0.4, 4.0, 10)
    exact = [sensor for sensor in drawn if not sensor.deviation_m(depth).any()]
    assert 0 < len(exact) < len(drawn)
    assert all(
        (sensor.measure(plane(2.0), np.array([BLACK]), np.random.default_rng(0)) == 2.0).all() for sensor in exact
    )
    for sensor in drawn:
        if sensor not in exact:
            assert np.allclose(sensor.deviation_m(depth), DepthSensor().deviation_m(depth))


def test_the_far_half_of_a_ball_is_seen_by_no_single_camera() -> None:
    shows = undisturbed().shows[0] / 300.0
    assert 0.2 < shows.max() < 0.5
    assert (undisturbed().seen[0] > 0).mean() > 0.75


@pytest.mark.parametrize("volume", ["blocks", "dense"])
def test_the_surface_is_fused_where_it_is(tmp_path: Path, volume: str) -> None:
    bounds = np.array([[-0.6, -0.6, -0.1], [0.6, 0.6, 1.1]])
    fuse(undisturbed(), Fusion(0.02, 4.0, volume, 5.0), bounds, tmp_path / "scene.safetensors")  # type: ignore[arg-type]
    field = open_field(tmp_path / "scene.safetensors")
    points, _ = BALL.sample(400, np.random.default_rng(5))
    distance = field.signed_distance(torch.from_numpy(points[points[:, 2] > 0.3]))
    assert float(distance.abs().median()) < 0.005
    assert abs(float(distance.median())) < 0.004
    assert [path.name for path in tmp_path.iterdir()] == ["scene.safetensors"]


def test_drift_carries_the_map_where_the_truth_says(tmp_path: Path) -> None:
    shift = np.eye(4)
    shift[:3, 3] = (0.1, -0.05, 0.02)
    moved = taken(np.tile(shift, (10, 1, 1)))
    motion, spread = moved.carried(0, BALL.vertices)
    assert np.allclose(motion, shift, atol=1e-9)
    assert spread == pytest.approx(0.0, abs=1e-9)
    fuse(moved, Fusion(0.02, 4.0, "blocks", 5.0), np.zeros((2, 3)), tmp_path / "scene.safetensors")
    points, _ = BALL.shifted(0.1, -0.05, 0.02).sample(400, np.random.default_rng(5))
    field = open_field(tmp_path / "scene.safetensors")
    assert float(field.signed_distance(torch.from_numpy(points[points[:, 2] > 0.35])).abs().median()) < 0.005


def test_symmetries_are_those_of_the_shape() -> None:
    can = Model("can", turned([(0.0, 0.0), (0.05, 0.0), (0.05, 0.12), (0.0, 0.12)], 64))
    exact, _ = measure_symmetries(can)
    assert len(exact["symmetries_continuous"]) == 1
    assert len(exact["symmetries_discrete"]) == 1  # upside down
    brick, _ = measure_symmetries(Model("brick", box((0.0, 0.0, 0.0), (0.1, 0.2, 0.3))))
    assert len(brick["symmetries_discrete"]) == 3
    assert brick["symmetries_continuous"] == []
    wedge = Model("wedge", turned([(0.0, 0.0), (0.2, 0.0), (0.0, 0.3)], 3).shifted(0.3, 0.0, 0.0))
    flat, _ = measure_symmetries(wedge)
    assert len(flat["symmetries_discrete"]) == 2  # a pyramid on three sides
