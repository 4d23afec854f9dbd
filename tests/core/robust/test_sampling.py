"""What is sampled, what is set aside, and what the search starts from."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.errors import InvalidDetectionError, NoSurfaceError
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.robust.scene import support_planes
from regnf_core.robust.search.bounds import super_fibonacci, turns_about
from regnf_core.robust.working_frame import sample_object_surface, sample_scene_surface
from tests.core.analytic import AnalyticField, chair, chair_pose, room, sphere
from tests.core.robust.shapes import detection, random_pose


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_object_samples_are_near_the_surface_even_and_cheap() -> None:
    field = CountingField(sphere(0.4, (0.3, -0.2, 0.1), [[-2.0] * 3, [2.0] * 3]))
    found = sample_object_surface(field, 2000, generator())
    back = found.frame.out_of(found.samples.on_surface())
    radius = (back - torch.tensor([0.3, -0.2, 0.1])).norm(dim=-1)
    assert len(found.samples) > 800
    assert (radius - 0.4).abs().max() < 2e-3
    assert found.frame.length == pytest.approx(0.8, rel=0.01)
    octants = (back - back.mean(0) > 0).long() @ torch.tensor([1, 2, 4])
    counts = torch.bincount(octants, minlength=8)
    assert counts.min() > 0.8 * counts.max()
    assert field.evaluations < 30_000


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_same_number_of_samples_at_any_scale(scale: float) -> None:
    plain = sample_object_surface(chair(), 5000, generator())
    other = sample_object_surface(TransformedField(chair(), random_pose(0, scale)), 5000, generator())
    assert 0.5 < len(other.samples) / len(plain.samples) < 2.0


def test_a_cavity_within_matter_is_not_sampled() -> None:
    def shell(points: Tensor) -> Tensor:
        radius = points.norm(dim=-1)
        return torch.maximum(radius - 0.5, 0.3 - radius)

    found = sample_object_surface(AnalyticField(shell, [[-1.0] * 3, [1.0] * 3]), 4000, generator())
    radius = found.frame.out_of(found.samples.on_surface()).norm(dim=-1)
    assert radius.min() > 0.45


def test_floor_and_walls_are_told_from_the_chair_in_any_orientation() -> None:
    turn = random_pose(4, 1.0)
    old = detection()
    box = OrientedBox(turn.apply(old.center[None])[0], old.size, turn.rotation @ old.rotation)
    scene = TransformedField(room(chair_pose()), turn.inverse())
    found = sample_scene_surface(scene, box, 4000, generator())
    surface = turn.inverse().apply(found.frame.out_of(found.samples.on_surface()))
    on_chair = chair().signed_distance(chair_pose().apply(surface)).abs() < 0.02
    aside = support_planes(found.samples, generator())
    assert (aside & (surface[:, 2] < 0.005)).sum() == (surface[:, 2] < 0.005).sum() > 200
    assert (aside & on_chair & (surface[:, 2] > 0.03)).sum() == 0


def test_an_empty_box_and_a_box_elsewhere_are_refused() -> None:
    with pytest.raises(NoSurfaceError) as empty:
        sample_scene_surface(
            room(chair_pose()), OrientedBox.from_corners([-0.8, 0.3, 0.4], [-0.6, 0.5, 0.6]), 500, generator()
        )
    assert empty.value.reason == "NO_SURFACE_IN_DETECTION"
    with pytest.raises(InvalidDetectionError) as elsewhere:
        sample_scene_surface(room(chair_pose()), OrientedBox.from_corners([5, 5, 5], [6, 6, 6]), 500, generator())
    assert elsewhere.value.reason == "DETECTION_OUTSIDE_SCENE"


def test_rotations_are_proper_and_cover_all_of_them() -> None:
    R = super_fibonacci(600)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(600, 3, 3))
    assert (torch.linalg.det(R) > 0).all()
    other = torch.stack([random_pose(k, 1.0).rotation for k in range(200)])
    trace = torch.einsum("aij,bij->ab", R, other)
    angle = ((trace.amax(0) - 1) / 2).clamp(-1, 1).acos()
    assert angle.max() < 0.61  # 35 degrees
    quarter = turns_about(torch.tensor([0.0, 0.0, 1.0]), 4)[1]
    expected = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(quarter, expected, atol=1e-12, rtol=0)
