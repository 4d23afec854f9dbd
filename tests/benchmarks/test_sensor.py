"""The depth camera's errors against the published formula."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.worlds.rendering import DepthSensor, intrinsics_of, jumps

SIZE = (200, 300)
FACING = np.ones(SIZE)
EXACT = {"step_m": 0.1}
"""Steps that the axial noise does not leave."""


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize(("depth", "deviation"), [(0.8, 0.001504), (2.0, 0.006064), (4.0, 0.025824)])
def test_axial_noise_grows_with_the_square_of_the_distance(depth: float, deviation: float) -> None:
    read = DepthSensor().measure(np.full(SIZE, depth), FACING, rng())
    assert (read > 0.0).all()
    # 60,000 readings: the deviation is known to .3 %, the mean to .4 % of it; rounding to 1 mm adds 1/12 mm^2.
    expected = np.hypot(deviation, 0.001 / np.sqrt(12.0))
    assert read.std() == pytest.approx(expected, rel=0.015)
    assert read.mean() == pytest.approx(depth, abs=0.02 * deviation)
    np.testing.assert_allclose(1000.0 * read, np.round(1000.0 * read), atol=1e-6)


def test_nothing_is_read_beyond_the_range_at_grazing_angles_and_of_nothing() -> None:
    sensor = DepthSensor(**EXACT, edge_jump_m=np.inf, lateral_pixels=0.0)
    depth = np.full(SIZE, 1.0)
    depth[0], depth[1], depth[2] = 0.3, 5.3, 0.0
    cosine = FACING.copy()
    cosine[3] = np.cos(np.radians(81.0))
    cosine[4] = np.cos(np.radians(79.0))
    read = sensor.measure(depth, cosine, rng())
    assert (read[:4] == 0.0).all()
    np.testing.assert_allclose(read[4:], 1.0)
    assert (sensor.measure(np.zeros(SIZE), FACING, rng()) == 0.0).all()


def test_a_share_of_the_readings_at_edges_is_lost() -> None:
    depth = np.full(SIZE, 1.0)
    depth[:, 150:] = 2.0
    sensor = DepthSensor(**EXACT, lateral_pixels=0.0, edge_dropout=0.25)
    read = sensor.measure(depth, FACING, rng())
    assert (read[:, :149] > 0.0).all()
    assert (read[:, 151:] > 0.0).all()
    assert (read[:, 149:151] == 0.0).mean() == pytest.approx(0.25, abs=0.07)


def test_a_slanted_plane_has_no_edges_and_a_step_has() -> None:
    # z at pixel u of the plane z = 1 + 3 x: x = z (u - c) / f, so z = 1 / (1 - 3 (u - c) / f).
    focal = intrinsics_of(SIZE, 60.0)[0, 0]
    slope = (np.arange(SIZE[1]) + 0.5 - 150.0) / focal
    depth = np.tile(1.0 / (1.0 - 1.6 * slope), (SIZE[0], 1))
    assert np.abs(np.diff(depth)).max() > 0.05  # far more than a step from pixel to pixel
    assert not jumps(depth, 0.05).any()
    depth[:, 200:] += 0.2
    assert set(np.nonzero(jumps(depth, 0.05))[1]) == {199, 200}


def test_the_lateral_error_moves_edges_and_nothing_else() -> None:
    depth = np.full(SIZE, 1.0)
    depth[:, 150:] = 2.0
    sensor = DepthSensor(**EXACT, edge_dropout=0.0, lateral_pixels=0.8 * 640 / SIZE[1])  # .8 of these pixels
    read = sensor.measure(depth, FACING, rng())
    assert set(np.unique(read)) == {1.0, 2.0}
    wrong = (read != depth).mean(axis=0)
    # A normal error of .8 pixels rounds to one or more to one side with probability P(x > .5) = .266.
    assert wrong[149] == pytest.approx(0.266, abs=0.09)
    assert wrong[150] == pytest.approx(0.266, abs=0.09)
    assert (wrong[:144] == 0.0).all()
    assert (wrong[156:] == 0.0).all()
