"""The region of a detection: distances by formulas, free space and what was not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_core.errors import DatasetError
from regnf_core.fields.observation import observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_fit.images.focus import focused_field
from tests.data.recordings.test_detection import CENTER, RADIUS, ball_image

TURN = np.array([[0.0, -1.0, 0.0, 0.4], [0.6, 0.0, -0.8, -0.2], [0.8, 0.0, 0.6, 1.0], [0.0, 0.0, 0.0, 1.0]])
"""From the camera to the world."""
PIXEL = CENTER[2] / 150.0
"""The width of a pixel at the ball."""


def region(around: float = 0.4) -> OrientedBox:
    """About the ball, along the camera's axes, in the world."""
    center = torch.from_numpy(TURN[:3, :3] @ CENTER + TURN[:3, 3])
    return OrientedBox(center, torch.full((3,), around, dtype=torch.float64), torch.from_numpy(TURN[:3, :3].copy()))


def world(points: np.ndarray) -> torch.Tensor:  # type: ignore[type-arg]
    return torch.from_numpy(points @ TURN[:3, :3].T + TURN[:3, 3])


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_distances_near_the_seen_surface_are_those_of_the_ball(noise: float) -> None:
    frame, _ = ball_image()
    rng = np.random.default_rng(3)
    depth = (frame.depth + noise * rng.normal(size=frame.depth.shape)).astype(np.float32)
    field = focused_field([replace(frame, depth=depth, T_world_camera=TURN)], region())
    # The part of the ball that faces the camera, and shells a little before and behind it.
    toward = -CENTER / np.linalg.norm(CENTER)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[directions @ toward > 0.6]
    for shell in (-0.008, 0.0, 0.008, 0.02):
        distance = field.signed_distance(world(CENTER + (RADIUS + shell) * directions)).numpy()
        # A pixel is 6 mm wide there. On the surface the planes hold; beside it, the mean over a voxel counts too.
        assert np.abs(np.median(distance) - shell) < (0.05 if shell == 0.0 else 0.2) * PIXEL
        assert np.quantile(np.abs(distance - shell), 0.95) < 0.5 * PIXEL
    observation = observation_of(field)
    assert observation is not None
    before, on, behind = (world(CENTER + (RADIUS + d) * toward * np.ones((1, 1))) for d in (0.05, 0.0, -0.06))
    assert [int(observation.at(p)) for p in (before, on, behind)] == [FREE, SURFACE, UNSEEN]


def test_distances_do_not_depend_on_how_many_nodes_are_done_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, ball = ball_image()
    found = []
    for nodes in (1, 1 << 30):
        monkeypatch.setattr("regnf_fit.images.focus._AT_ONCE", nodes)
        field = focused_field([replace(frame, T_world_camera=TURN)], region(), things=[ball])
        points = world(CENTER + 0.1 * np.random.default_rng(0).normal(size=(2000, 3)))
        found.append((field.signed_distance(points), observation_of(field)))
    assert torch.allclose(found[0][0], found[1][0], atol=1e-7)
    first, second = (seen for _, seen in found)
    assert first is not None
    assert second is not None
    assert torch.equal(first.states, second.states)


def test_nobody_saw_the_thing_where_an_image_shows_others() -> None:
    frame, ball = ball_image()
    left = ball & (np.arange(ball.shape[1]) < np.median(np.nonzero(ball)[1]))
    frame = replace(frame, T_world_camera=TURN)
    told, all_of_it = (focused_field([frame], region(), things=[mask]) for mask in (left, ball))
    observation, whole = observation_of(told), observation_of(all_of_it)
    assert observation is not None
    assert whole is not None
    assert observation.of_thing
    middle = (observation.measured() - world(CENTER[None])) @ torch.from_numpy(TURN[:3, :3].copy())
    assert 0.3 < len(middle) / len(whole.measured()) < 0.7
    assert float(middle[:, 0].max()) < float(-middle[:, 0].min()) / 2.0, "no surface right of the middle"
    points = world(CENTER + 0.1 * np.random.default_rng(0).normal(size=(500, 3)))
    assert torch.equal(told.signed_distance(points), all_of_it.signed_distance(points)), "what is there, is there"
    assert torch.equal(observation.at(points) == FREE, whole.at(points) == FREE)


def test_a_region_without_a_surface_is_refused() -> None:
    frame, _ = ball_image()
    with pytest.raises(DatasetError, match="no depth image shows a surface in the region") as found:
        focused_field([frame], OrientedBox.from_corners([5, 5, 5], [6, 6, 6]))
    assert found.value.reason == "DATASET_NOTHING_IN_BOUNDS"
