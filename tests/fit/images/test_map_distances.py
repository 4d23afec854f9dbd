"""Distances near the surface of a ball and a box, from the map that their depth images fuse to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_data.posed_images import PosedImages
from regnf_fit.images.fusion import MapDistances, map_distances, measured_rays, sharp_width
from regnf_fit.images.preparation import PreparedImages, prepare
from tests.fit.images import scenes

IMAGES = scenes.images(count=12, height=72, width=96)


def drawn(images: PosedImages) -> tuple[PreparedImages, MapDistances]:
    rng = np.random.default_rng(3)
    prepared = prepare(images, "auto", rng)
    return prepared, map_distances(images, prepared, rng)


@pytest.fixture(scope="module")
def both() -> tuple[PreparedImages, MapDistances]:
    return drawn(IMAGES)


@pytest.fixture(scope="module")
def near(both: tuple[PreparedImages, MapDistances]) -> MapDistances:
    return both[1]


def test_the_distances_are_those_of_the_true_surface(near: MapDistances) -> None:
    exact = scenes.distance(near.points.numpy())
    error = np.abs(near.distances.numpy() - exact)
    # the pixels are 15 mm wide at the surface
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.9) < 0.012


def test_the_places_lie_on_both_sides_of_the_surface_and_no_farther_than_the_map_reaches(
    both: tuple[PreparedImages, MapDistances],
) -> None:
    prepared, near = both
    voxel = sharp_width(prepared, measured_rays(prepared))
    assert float(near.distances.abs().max()) <= 0.75 * 4.0 * voxel * 1.001
    assert 0.3 < float((near.distances < 0.0).float().mean()) < 0.6
    assert float((near.distances.abs() < 0.2 * voxel).float().mean()) > 0.25


def test_a_near_surface_counts_like_a_far_one() -> None:
    """One of two balls fills four times the pixels of the other: their surfaces are as large."""
    images = scenes.images(count=12, height=72, width=96, ball_alone=True)
    assert images.depths is not None
    toward = images.T_world_camera[:, :3, 3] @ scenes.BALL_CENTER
    pixels = (images.depths > 0.0).sum(axis=(1, 2))
    assert pixels[toward.argmax()] > 1.5 * pixels[toward.argmin()]
    _, near = drawn(images)
    outward = near.points.numpy() - scenes.BALL_CENTER
    shares = [(outward[:, axis] > 0.0).mean() for axis in range(3)]
    assert np.allclose(shares, 0.5, atol=0.06)


def test_what_is_uneven_is_told(near: MapDistances) -> None:
    is_detailed = torch.zeros(len(near.points), dtype=torch.bool)
    is_detailed[near.detailed] = True
    beyond = np.abs(near.points.numpy() - scenes.BOX_CENTER) - scenes.BOX_HALF
    faces = torch.from_numpy((np.sort(beyond, axis=1)[:, 1] < -0.06) & (beyond.max(axis=1) > -0.02))
    edges = torch.from_numpy((np.sort(beyond, axis=1)[:, 1] > -0.01) & (beyond.max(axis=1) < 0.01))
    # a cell of 30 mm seldom holds enough pixels of 15 mm to tell
    assert float(is_detailed[edges].float().mean()) > 0.1
    assert float(is_detailed[faces].float().mean()) < 0.01


def test_pixels_held_out_do_not_count(both: tuple[PreparedImages, MapDistances]) -> None:
    prepared, near = both
    assert IMAGES.depths is not None
    assert np.array_equal(IMAGES.depths.reshape(-1)[prepared.held_out_pixels], prepared.held_out.depths.numpy())
    wrong = IMAGES.depths.copy()
    wrong.reshape(-1)[prepared.held_out_pixels] *= 0.99
    again = map_distances(replace(IMAGES, depths=wrong), prepared, _spent(np.random.default_rng(3)))
    assert torch.equal(near.distances, again.distances)
    wrong *= 0.99
    assert not torch.equal(near.distances, drawn(replace(IMAGES, depths=wrong))[1].distances)


def _spent(rng: np.random.Generator) -> np.random.Generator:
    """The generator as :func:`prepare` leaves it."""
    prepare(IMAGES, "auto", rng)
    return rng
