"""Surface that nobody can have seen: the space in front of it was not seen to be free."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import OCCLUSION
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.scene import SingleView, occlusion_boundary, view_scene
from regnf_core.robust.working_frame import Samples, WorkingFrame, WorkingObservation, clearance, sample_object_surface
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes

CELLS, VOXEL = 20, 0.1
MIDDLE = CELLS // 2


def wall_seen_from_above(margin: int = 0) -> Observation:
    """Free above z = .1, a surface measured in the layer below it, nothing seen farther down. The grid's middle is 0.

    margin: so many layers above the surface count as unobserved.
    """
    states = torch.full((CELLS, CELLS, CELLS), UNSEEN, dtype=torch.uint8)
    states[:, :, MIDDLE] = SURFACE
    states[:, :, MIDDLE + 1 + margin :] = FREE
    return Observation(states, torch.full((3,), -MIDDLE * VOXEL, dtype=torch.float64), VOXEL)


def in_frame(observation: Observation, T_frame_new: Sim3) -> WorkingObservation:
    """Of the observation in a frame that ``T_frame_new`` carries to the grid's, with a working frame half as large."""
    moved = observation.seen_in(T_frame_new)
    center = T_frame_new.inverse().apply(torch.zeros(1, 3, dtype=torch.float64))[0]
    return WorkingObservation(moved, WorkingFrame(center, 2.0))


def turned(T: Sim3, vectors: Tensor) -> Tensor:
    return (vectors.double() @ T.rotation).float()


def placed(T: Sim3, points: Tensor) -> Tensor:
    """Points (N, 3) of the grid in the working frame."""
    center = T.inverse().apply(torch.zeros(1, 3, dtype=torch.float64))
    return ((T.inverse().apply(points.double()) - center) / 2.0).float()


IN_FRAMES = pytest.mark.parametrize(
    "T",
    [Sim3.identity(), Sim3.identity().perturb(torch.tensor([0.4, -0.9, 0.3, 0.5, -0.2, 0.7, 0.8]).double())],
    ids=["the grid's own frame", "another frame"],
)


@IN_FRAMES
@pytest.mark.parametrize("margin", [0, 1])
def test_what_faces_free_space_may_have_been_seen(T: Sim3, margin: int) -> None:
    seen = in_frame(wall_seen_from_above(margin), T)
    points = placed(T, torch.tensor([[0.03, -0.21, 0.05], [0.5, 0.3, 0.05], [0.03, -0.21, 0.05]]))
    normals = turned(T, torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8]]))
    assert seen.faces_unobserved(points, normals).tolist() == [False, True, True]
    assert not seen.unobserved(points, torch.zeros(3)).any(), "a surface was measured there"


@IN_FRAMES
def test_states_in_a_working_frame_are_those_of_the_observation(T: Sim3) -> None:
    observation = wall_seen_from_above()
    seen = in_frame(observation, T)
    generator = torch.Generator().manual_seed(0)
    cells = torch.randint(-2, CELLS + 2, (500, 3), generator=generator)
    points = (cells + 0.2 + 0.6 * torch.rand(500, 3, generator=generator) - MIDDLE) * VOXEL
    states = observation.at(points)
    assert (seen.on_surface(placed(T, points)) == (states == SURFACE)).all()
    assert (seen.unobserved(placed(T, points), torch.zeros(500)) == (states == UNSEEN)).all()
    assert 0 < int((states == SURFACE).sum()) < int((states == UNSEEN).sum())


def test_a_voxel_with_surface_tells_nothing_of_places_off_the_surface() -> None:
    seen = in_frame(wall_seen_from_above(), Sim3.identity())
    places = placed(Sim3.identity(), torch.tensor([[0.03, -0.21, 0.05], [0.03, -0.21, 0.65]])).repeat_interleave(3, 0)
    distances = torch.tensor([0.029, 0.031, -0.031]).repeat(2)
    assert seen.on_surface(places).tolist() == [True] * 3 + [False] * 3
    assert seen.unobserved(places, distances).tolist() == [False, True, True] + [False] * 3, "free is free"


def test_a_single_view_sees_what_faces_it() -> None:
    view = SingleView(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.1]])
    assert view.faces_unobserved(points, normals).tolist() == [False, True, True]
    assert view.unobserved(points, torch.tensor([0.1, -0.1, 0.0])).tolist() == [False, True, False]


class Slab:
    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """z and its gradient."""
        return points[:, 2], torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)


def test_the_far_side_of_a_sheet_is_unobserved_and_its_near_side_is_not() -> None:
    """A sheet that coincides with what was measured: the scene's surface has the normal of one of its sides."""
    view = SingleView(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    points, up = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    sheet = Samples(points, torch.zeros(2), torch.cat([up, -up]))
    scene = Samples(points, torch.zeros(2), up.expand(2, 3), unobserved=view)
    found = residuals(SurfacePair(Slab(), Slab(), scene, sheet), Sim3.identity().expand(1))
    assert found.unobserved is not None
    assert found.unobserved[0].tolist() == [False, False, False, True]


def test_a_scene_sample_that_nobody_saw_from_its_front_counts_only_where_the_object_faces_the_same_way() -> None:
    """The back of a measured sheet, as truncated distances have one, does not contradict an object without it."""
    points, up = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    view = SingleView(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    scene = Samples(points, torch.zeros(3), torch.cat([up, -up, up]), view, hidden=torch.tensor([False, True, True]))
    sheet = Samples(points[:1], torch.zeros(1), up)
    found = residuals(SurfacePair(Slab(), Slab(), scene, sheet), Sim3.identity().expand(1))
    assert found.unobserved is not None
    assert found.unobserved[0].tolist() == [False, True, False, False]
    narrower = scene[torch.tensor([2, 1])].on("cpu")
    assert narrower.hidden is not None
    assert narrower.hidden.tolist() == [True, True]


def plate_seen_from_above() -> ObservedField:
    """A plate, .08 thick, whose upper side alone was seen, in voxels of .1: they hold both sides."""
    plate = AnalyticField(
        lambda x: torch.maximum((x[:, :2].abs() - 0.6).amax(-1), (x[:, 2] - 0.05).abs() - 0.04), [[-1.0] * 3, [1.0] * 3]
    )
    return ObservedField(plate, wall_seen_from_above())


def test_a_view_knows_which_of_its_samples_nobody_saw_from_their_front() -> None:
    box = OrientedBox.from_corners([-0.7, -0.7, -0.2], [0.7, 0.7, 0.3])
    foreground = view_scene(plate_seen_from_above(), box, RobustOptions()).foreground
    assert foreground.hidden is not None
    up, down = foreground.normals[:, 2] > 0.9, foreground.normals[:, 2] < -0.9
    assert min(int(up.sum()), int(down.sum())) > 100
    assert bool(foreground.hidden[down].all())
    assert not bool(foreground.hidden[up].any())


def test_an_objects_model_has_no_surface_that_nobody_saw_from_its_front() -> None:
    plate = plate_seen_from_above()
    whole, seen = (
        sample_object_surface(one, 2000, torch.Generator().manual_seed(0)).samples for one in (plate.field, plate)
    )
    assert int((whole.normals[:, 2] < -0.9).sum()) > 300
    assert len(seen) > 300
    assert bool((seen.normals[:, 2] > 0.9).all())


# How far from measured surface space begins to be known free, by layers of voxels; and what that decides.


COUNT, EDGE, SURFACE_LAYER = 40, 0.05, 20
TOP = SURFACE_LAYER * EDGE


def layers(measured: int, margin: int) -> Observation:
    """A surface in so many layers below z = 0, so many unseen ones above it, free space above those."""
    states = torch.full((COUNT, COUNT, COUNT), UNSEEN, dtype=torch.uint8)
    states[:, :, SURFACE_LAYER - measured : SURFACE_LAYER] = SURFACE
    states[:, :, SURFACE_LAYER + margin :] = FREE
    return Observation(states, torch.full((3,), -TOP, dtype=torch.float64), EDGE)


@pytest.mark.parametrize(
    ("measured", "margin", "expected"),
    [(1, 0, 2.0), (1, 1, 2.0), (1, 3, 4.0), (4, 2, 6.0), (1, 20, OCCLUSION.max_clearance)],
)
def test_the_deepest_measured_layer_tells(measured: int, margin: int, expected: float) -> None:
    """The nearest free voxel lies as many layers above the deepest measured one."""
    assert clearance(layers(measured, margin)) == expected


def test_a_quantile_of_the_layers() -> None:
    """A tenth of the measured voxels lie deeper than the others, 7 layers from free space instead of 3."""
    observation = layers(1, 2)
    observation.states[: COUNT // 20, :, SURFACE_LAYER - 5 : SURFACE_LAYER - 1] = UNSEEN
    observation.states[: COUNT // 20, :, SURFACE_LAYER - 5] = SURFACE
    assert clearance(observation) == 3.0


def test_without_a_measured_surface_it_is_the_least() -> None:
    observation = layers(1, 2)
    observation.states[observation.states == SURFACE] = UNSEEN
    assert clearance(observation) == OCCLUSION.min_clearance


def test_surface_within_a_noisy_layer_was_seen_from_above_and_not_from_below() -> None:
    seen = WorkingObservation(layers(4, 2), WorkingFrame(torch.zeros(3, dtype=torch.float64), 2.0))
    points = torch.tensor([[0.0, 0.0, -2.0 * EDGE]]).expand(2, 3) / 2.0
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    assert seen.faces_unobserved(points, normals).tolist() == [False, True]


def test_the_model_of_a_noisy_scan_keeps_the_surface_that_was_seen() -> None:
    """A plate seen from above, half of it by noisy depths: all of its upper side is the model, and its lower side,
    which nobody saw, is no part of it."""
    observation = layers(4, 2)
    observation.states[SURFACE_LAYER:] = layers(2, 0).states[SURFACE_LAYER:]
    plate = ObservedField(boxes([([-0.5, -0.5, -6.0 * EDGE], [0.5, 0.5, -1.5 * EDGE])]), observation)
    found = sample_object_surface(plate, 4000, torch.Generator().manual_seed(0))
    points = found.frame.out_of(found.samples.on_surface())
    assert (points[:, 2] > -2.0 * EDGE).float().mean() > 0.9
    assert 0.4 < (points[:, 0] < 0.0).float().mean() < 0.6


# A scene observed from one side: its occlusion boundary is found, and unobserved places weigh little.


def test_edge_on_surface_is_told_from_surface_that_faces_the_viewpoint() -> None:
    generator = torch.Generator().manual_seed(0)
    viewpoint = torch.tensor([1.5, -0.4, 0.8])
    edges = torch.rand(300, 3, generator=generator) - 0.5
    across = normalize(torch.linalg.cross(viewpoint - edges, torch.randn(300, 3, generator=generator)), dim=-1)
    points = torch.rand(400, 3, generator=generator) - 0.5
    sight = normalize(viewpoint - points, dim=-1)
    normals = normalize(sight + 0.4 * torch.randn(400, 3, generator=generator), dim=-1)
    facing = (normals * sight).sum(-1) > 0.2
    places, along = torch.cat([edges, points[facing]]), torch.cat([across, normals[facing]])
    found = occlusion_boundary(Samples(places, torch.zeros(len(places)), along), generator)[0]
    assert found[:300].float().mean() > 0.98
    assert found[300:].float().mean() < 0.02


def test_what_was_observed_from_all_sides_has_no_occlusion_boundary() -> None:
    generator = torch.Generator().manual_seed(0)
    normals = normalize(torch.randn(800, 3, generator=generator), dim=-1)
    assert not occlusion_boundary(Samples(0.4 * normals, torch.zeros(800), normals), generator)[0].any()
