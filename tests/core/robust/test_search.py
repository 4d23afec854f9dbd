"""The search: seeds, candidates, bounds, features."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from regnf_core.fields.composite import TransformedField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import displacement
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.options import RegistrationOptions
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.model import model_object
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.search import bounds
from regnf_core.robust.search.bounds import PoseBound, super_fibonacci
from regnf_core.robust.search.distance_grid import DistanceGrid, feature_seeds, nearest_sample_distance
from regnf_core.robust.working_frame import Samples
from tests.core.analytic import AnalyticField, sphere, union
from tests.core.robust.shapes import random_pose, reframed

# Seeds of the search: the same poses, however many are made at once.


def poses(points: torch.Tensor) -> torch.Tensor:
    scales = torch.tensor([0.85, 1.0, 1.18])
    axes, size = torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    return bounds.seed_poses(points, 2.0 * points, axes, size, super_fibonacci(61), scales).matrix()


def test_turned_in_parts_objects_have_the_same_extents(monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    whole = poses(points)
    monkeypatch.setattr(bounds, "_POINTS_AT_ONCE", 10_000)
    assert torch.equal(poses(points), whole)
    monkeypatch.setattr(bounds, "_POINTS_AT_ONCE", 1)
    assert poses(points).shape == whole.shape


# Copies of pose candidates.


def candidates() -> PoseCandidates:
    poses = Sim3.cat([random_pose(1, 1.0), random_pose(2, 3.0)])
    return PoseCandidates(poses, torch.tensor([0.1, 0.2]), torch.tensor([0.01, 0.02]))


def test_copies_are_about_as_far_off_as_the_spread_says() -> None:
    own = candidates()
    found = own.with_copies(400, (0.1, 0.03, 0.05), torch.Generator().manual_seed(0))
    assert len(found) == 2 * 401
    torch.testing.assert_close(found.T[:2].matrix(), own.T.matrix(), rtol=0, atol=0)
    assert found.scores.tolist() == own.scores.tolist() * 401
    for number in (0, 1):
        copies = found.T[number + 2 :: 2]
        growth = (copies.scale / own.T.scale[number]).log()
        turn = (copies.rotation @ own.T.rotation[number].mT).diagonal(dim1=-2, dim2=-1).sum(-1)
        angle = ((turn - 1.0) / 2.0).clamp(-1.0, 1.0).acos()
        assert 0.045 < float(growth.std()) < 0.055
        assert 0.09 < float((angle.square().mean() / 3.0).sqrt()) < 0.11


# What a detection allows: by hand, for a cube of edge 1 in a box of edge 2, scaled to a diagonal of 1.

CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
EDGE = 1.0 / math.sqrt(3.0)
"""Of the box, in the scene's working frame."""


def bound(tolerance: float, rotation: torch.Tensor | None = None) -> PoseBound:
    turn = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
    box = OrientedBox(torch.tensor([5.0, 6.0, 7.0]), torch.tensor([2.0, 2.0, 2.0]), turn)
    return PoseBound.of(box, CORNERS, tolerance)


def placed(edge: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sim3:
    """The pose that lays the cube with this edge, as a share of the box's, at ``center``, in shares of it too."""
    at = Sim3(
        torch.tensor([edge * EDGE], dtype=torch.float64),
        torch.eye(3, dtype=torch.float64)[None],
        torch.tensor([center], dtype=torch.float64) * EDGE,
    )
    return at.inverse()


@pytest.mark.parametrize(
    ("degrees", "admitted"), [(0.0, True), (29.0, True), (31.0, False), (90.0, False), (180.0, False)]
)
def test_a_known_vertical_admits_no_toppled_pose(degrees: float, admitted: bool) -> None:
    """Tilted about x, the cube's vertical leaves the scene's by the angle; turned about z, it stays."""
    for axis, stays in (("z", admitted), ("x", True)):
        tilt = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        turn = Rotation.from_euler("z", 70.0, degrees=True).as_matrix() if axis == "z" else np.eye(3)
        T = replace(placed(0.5), rotation=torch.from_numpy(tilt @ turn)[None])
        assert replace(bound(0.5), up_axis=axis).admits(T).tolist() == [stays]
        assert bound(0.5).admits(T).tolist() == [True]


@pytest.mark.parametrize(
    ("edge", "center", "tolerance", "admitted"),
    [
        (1.0, (0.0, 0.0, 0.0), 0.0, True),
        (1.01, (0.0, 0.0, 0.0), 0.0, False),
        (0.9, (0.04, 0.0, 0.0), 0.0, True),
        (0.9, (0.0, 0.0, 0.06), 0.0, False),
        (1.9, (0.0, 0.0, 0.0), 0.5, True),
        (2.1, (0.0, 0.0, 0.0), 0.5, False),
        (0.26, (0.0, 0.0, 0.0), 0.5, True),
        (0.24, (0.0, 0.0, 0.0), 0.5, False),
        (160.0, (0.0, 0.0, 0.0), 1.0, False),
        (1 / 160.0, (0.0, 0.0, 0.0), 1.0, False),
    ],
)
def test_extent_and_place(edge: float, center: tuple[float, float, float], tolerance: float, admitted: bool) -> None:
    assert bound(tolerance).admits(placed(edge, center)).tolist() == [admitted]


def test_an_object_may_reach_beyond_what_was_seen_of_it_by_its_own_extent() -> None:
    """A third of it is seen: the box holds that part, at one end of the object."""
    poses = Sim3.cat([placed(3.0, (1.0, 0.0, 0.0)), placed(3.0, (1.0, 1.0, 1.0)), placed(3.0, (3.1, 0.0, 0.0))])
    seen = replace(bound(0.7), seen=True)
    assert bound(0.7).admits(poses).tolist() == [False, False, False]
    assert seen.admits(poses).tolist() == [True, True, False]
    assert seen.judged(poses)[1].tolist() == [0.0, 0.0, 0.0], "nobody knows where it ends"


def test_the_boxs_own_axes_count() -> None:
    """A box turned by 45 degrees about z sees the cube's diagonal, sqrt 2 edges long."""
    half = math.sqrt(0.5)
    turn = torch.tensor([[half, -half, 0.0], [half, half, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    poses = Sim3.cat([placed(0.70), placed(0.71)])
    assert bound(0.0, turn).admits(poses).tolist() == [True, False]
    assert bound(0.0, turn).loosened(2.0).admits(poses).tolist() == [True, False], "twice nothing"
    assert [one.admits(placed(1.3)).item() for one in (bound(0.1), bound(0.1).loosened(2.0))] == [False, True]


def test_a_pose_that_fills_the_box_is_not_penalized() -> None:
    """And by half of the weight where every face is one kernel width off."""
    off = placed(1.0 + 2.0 * SEARCH.box_width)
    poses = Sim3.cat([placed(1.0), placed(0.9), placed(0.5), placed(2.5), placed(1.0, (0.3, 0.0, 0.0)), off])
    exact, tight, small, large, beside, half = bound(1.0).judged(poses)[1].tolist()
    assert exact == pytest.approx(0.0, abs=1e-12)
    assert exact < tight < beside < small < large < SEARCH.box_weight
    assert half == pytest.approx(SEARCH.box_weight / 2)


@pytest.mark.parametrize(
    ("tolerance", "verdict", "reason"), [(0.0, "rejected", "OUTSIDE_DETECTION"), (1.0, "registered", "SURFACES_AGREE")]
)
def test_around_a_part_the_tolerance_decides(tolerance: float, verdict: str, reason: str) -> None:
    """Every edge of the box is 0.7 of the chair's. The search begins at the right pose, so it is the one judged."""
    scene, obj, box, truth = reframed(random_pose(1, 1.0), random_pose(2, 1.0))
    part = OrientedBox(box.center, 0.7 * box.size, box.rotation)
    options = RegistrationOptions.from_dict({"robust": {"box_tolerance": tolerance}})
    found = register(scene, obj, part, options, seed=0, initial_transform=truth, clouds=False)
    assert (found.verdict, found.verdict_reason) == (verdict, reason)
    assert float(found.T_object_scene.scale) == pytest.approx(float(truth.scale), rel=1e-3)


def test_a_flat_boxs_thickness_is_compared_with_more_than_itself() -> None:
    """A thing of 2 % of its length, whose field is three times as thick as its box, as coarse maps have it."""
    box = OrientedBox(torch.zeros(3), torch.tensor([1.0, 1.0, 0.02]), torch.eye(3, dtype=torch.float64))
    thick = CORNERS * torch.tensor([1.0, 1.0, 0.06])
    true = Sim3(
        torch.tensor([math.hypot(1.0, 1.0, 0.02)]).double(), torch.eye(3)[None].double(), torch.zeros(1, 3).double()
    )
    twice = Sim3(true.scale / 2.2, true.rotation, true.translation)
    assert PoseBound.of(box, thick, 0.5).admits(Sim3.cat([true, twice])).tolist() == [True, False]


# Feature matches: the pose among them whatever the scale and the frame, and nothing odd where there is nothing.


def blob() -> AnalyticField:
    """Balls of different sizes stuck together: curved differently everywhere. Flat faces would all look alike."""
    generator = torch.Generator().manual_seed(0)
    radii = [0.12, 0.16, 0.2, 0.24, 0.1, 0.14, 0.18]
    return union([sphere(r, (0.6 * torch.rand(3, generator=generator) - 0.3).tolist()) for r in radii])


def test_the_pose_is_among_the_seeds_at_any_scale() -> None:
    pose = random_pose(4, 37.0)
    one, two = model_object(TransformedField(blob(), pose.inverse())), model_object(blob())
    truth = two.frame.to_field().inverse() @ pose.inverse() @ one.frame.to_field()
    found = feature_seeds(one.samples, two.samples, 4, seed=1)
    assert displacement(found, truth, two.extremal_points).min() < 0.05
    torch.testing.assert_close(
        found.rotation @ found.rotation.mT, torch.eye(3).double().expand_as(found.rotation), atol=1e-9, rtol=0
    )
    again = feature_seeds(one.samples, two.samples, 4, seed=1)
    torch.testing.assert_close(again.rotation, found.rotation, rtol=0, atol=0)
    torch.testing.assert_close(again.scale, found.scale, rtol=0, atol=0)


def test_the_side_that_the_camera_sees_is_laid_on_what_was_seen() -> None:
    """Of a ball one side is seen: its middle is half a radius before the ball's."""
    normals = unit_directions()
    truth = Sim3(torch.tensor(1.5).double(), super_fibonacci(24)[7], torch.tensor([0.3, -0.2, 0.1]).double())
    axes = super_fibonacci(24)[3]
    seen = normals.double() @ truth.rotation @ axes[:, 2] < SEARCH.facing_cosine
    scene = truth.inverse().apply(0.5 * normals[seen].double())
    seeds = bounds.seen_seeds(scene, 0.5 * normals, normals, axes, super_fibonacci(24), 1.5)
    middle = seeds.inverse().apply(torch.zeros(1, 3).double())[:, 0]
    assert len(seeds) == 6 * 24
    assert torch.allclose(middle, truth.inverse().translation.expand_as(middle), atol=0.02)
    # Of the left half of that side the middle is half a radius off, as of its ends; by the end at one of four sides the
    # ball's own middle is found.
    across = normals.double() @ truth.rotation @ axes[:, 0]
    half = truth.inverse().apply(0.5 * normals[seen & (across < 0.0)].double())
    seeds = bounds.seen_seeds(half, 0.5 * normals, normals, axes, super_fibonacci(24), 1.5)
    off = (seeds.inverse().apply(torch.zeros(1, 3).double())[:, 0] - truth.inverse().translation).norm(dim=-1)
    nearest = off.reshape(6, 24).amax(1)
    assert float(nearest.min()) < 0.03 < 0.1 < float(nearest[:2].min())


def test_too_small_a_cloud_gives_no_seed() -> None:
    few = Samples(torch.randn(20, 3), torch.zeros(20), torch.tensor([[0.0, 0.0, 1.0]]).expand(20, 3))
    assert feature_seeds(few, model_object(blob()).samples, 2, seed=0).scale.numel() == 0
    assert feature_seeds(few, few, 0, seed=0).scale.numel() == 0


# Distance grids against the samples they are made of.


def unit_directions(count: int = 1500) -> torch.Tensor:
    draw = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return draw / draw.norm(dim=1, keepdim=True)


def made() -> tuple[torch.Tensor, DistanceGrid]:
    normals = unit_directions()
    return normals, DistanceGrid.of(0.5 * normals, normals, 0.05, SEARCH.grid_margin)


def test_holds_the_samples_distance_at_the_cells_centers() -> None:
    normals, grid = made()
    numbers = torch.randint(SEARCH.grid_cells, (200, 3), generator=torch.Generator().manual_seed(1))
    centers = grid.low[:, 0] + (numbers + 0.5) * grid.edge[:, 0]
    value, gradient = grid.value_and_gradient(centers)
    expected, slope = nearest_sample_distance(0.5 * normals, normals, 0.05, centers)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-6)


def test_goes_on_from_the_center_along_the_gradient() -> None:
    _, grid = made()
    center = grid.low[:, 0] + 10.5 * grid.edge[:, 0]
    value, gradient = grid.value_and_gradient(center[None])
    step = 0.4 * grid.edge[:, 0] * torch.tensor([1.0, -1.0, 0.5])
    moved, same = grid.value_and_gradient((center + step)[None])
    torch.testing.assert_close(same, gradient)
    torch.testing.assert_close(moved, value + (gradient[0] @ step)[None], rtol=0, atol=1e-6)


def test_adds_the_distance_to_the_grid_beyond_it() -> None:
    _, grid = made()
    border = torch.stack([grid.high[:, 0], torch.tensor([0.0, 0.0, float(grid.low[2, 0])])])
    outside = border + torch.tensor([[0.3, 0.4, 0.0], [0.0, 0.0, -2.0]])
    value, gradient = grid.value_and_gradient(outside)
    at_border, _ = grid.value_and_gradient(border)
    torch.testing.assert_close(value - at_border, torch.tensor([0.5, 2.0]))
    torch.testing.assert_close(gradient, torch.tensor([[0.6, 0.8, 0.0], [0.0, 0.0, -1.0]]))
