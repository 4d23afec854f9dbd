"""Surface that nobody can have seen: the space in front of it was not seen to be free."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.scene import SingleView, view_scene
from regnf_core.robust.working_frame import Samples, WorkingFrame, WorkingObservation, sample_object_surface
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField

COUNT, VOXEL = 20, 0.1
MIDDLE = COUNT // 2


def wall_seen_from_above(margin: int = 0) -> Observation:
    """Free above z = .1, a surface measured in the layer below it, nothing seen farther down. The grid's middle is 0.

    margin: so many layers above the surface count as unobserved.
    """
    states = torch.full((COUNT, COUNT, COUNT), UNSEEN, dtype=torch.uint8)
    states[:, :, MIDDLE] = SURFACE
    states[:, :, MIDDLE + 1 + margin :] = FREE
    return Observation(states, torch.full((3,), -MIDDLE * VOXEL, dtype=torch.float64), VOXEL)


def in_frame(observation: Observation, T_frame_new: Sim3) -> WorkingObservation:
    """Of the observation in a frame that ``T_frame_new`` carries to the grid's, with a working frame half as large."""
    moved = observation.seen_in(T_frame_new)
    center = T_frame_new.inverse().apply(torch.zeros(1, 3, dtype=torch.float64))[0]
    return WorkingObservation(moved, WorkingFrame(center, 2.0))


def turned(T: Sim3, vectors: Tensor) -> Tensor:
    """Directions (N, 3) of the grid in the new frame."""
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
    cells = torch.randint(-2, COUNT + 2, (500, 3), generator=generator)
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
    """Matter below z = 0."""

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
