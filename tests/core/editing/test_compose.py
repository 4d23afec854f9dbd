"""Edited scenes against closed forms: rooms and things whose distances are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_core import (
    Camera,
    Insertion,
    Removal,
    RenderOptions,
    Replacement,
    Sim3,
    Substitution,
    compose,
    open_field,
    render,
)
from regnf_core.editing.compose import standing_alike
from regnf_core.editing.edited_scene import without_unseen
from regnf_core.editing.edits import SCENE_PART, Edit
from regnf_core.editing.storing import write_field
from regnf_core.errors import NoSurfaceError, RegnfError
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import Observation, ObservedField, SdfField, has_color, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.description import SURFACE
from tests.core.analytic import AnalyticField, boxes, sphere, union

BALL = sphere(0.2)
BOUNDS = [[-1.0, -1.0, -0.1], [1.0, 1.0, 1.0]]
FLOOR = ([-1.0, -1.0, -0.1], [1.0, 1.0, 0.0])
WALL = ([-1.0, -1.0, -0.1], [-0.9, 1.0, 1.0])
STOOL = [
    ([-0.2, -0.2, 0.3], [0.2, 0.2, 0.36]),
    ([-0.2, -0.2, 0.0], [-0.13, -0.13, 0.3]),
    ([0.13, 0.13, 0.0], [0.2, 0.2, 0.3]),
]
SCALE = 2.5


def turned(scale: float = SCALE) -> Sim3:
    """T_object_scene of a stool that stands in the middle of the scene, turned by 30 degrees in its own frame."""
    return Sim3.exp(torch.tensor([0.0, 0.0, np.radians(30.0), 0.1, -0.2, 0.3, np.log(scale)], dtype=torch.float64))


def stool(T: Sim3) -> AnalyticField:
    """The stool in its own frame: S_object(y) = s S_scene(T^-1 y)."""
    here, scale = boxes(STOOL, BOUNDS), float(T.scale)
    corners = T.apply(
        torch.tensor([[x, y, z] for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (-0.05, 0.4)]).double()
    )
    bounds = torch.stack([corners.amin(0), corners.amax(0)])
    return AnalyticField(lambda y: scale * here.formula(T.inverse().apply(y)), bounds.tolist())


def room(*more: tuple[list[float], list[float]]) -> AnalyticField:
    return boxes([FLOOR, WALL, *more], BOUNDS)


def free_points(count: int = 4000, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor([-0.8, -0.8, 0.02]), torch.tensor([0.8, 0.8, 0.9])
    return low + (high - low) * torch.rand(count, 3, generator=generator)


def test_a_substitution_of_the_same_thing_changes_nothing() -> None:
    T, whole = turned(), room(*STOOL)
    edited = compose(whole, [Substitution(stool(T), T)])
    points = free_points()
    distance, gradient = edited.signed_distance_and_gradient(points)
    exact = whole.signed_distance(points)
    near = exact.abs() < 0.05
    assert (distance - exact)[near].abs().max() < 2e-3
    assert ((distance > 0) == (exact > 0))[exact.abs() > 2e-3].all()
    assert (distance <= exact + 2e-3)[exact > 0].all()  # never farther than the surface: rays may trust it
    assert torch.equal(distance, edited.signed_distance(points))
    moved = []
    for move in 1e-3 * torch.eye(3):
        moved.append(edited.signed_distance(points + move) - edited.signed_distance(points - move))
    differences = torch.stack(moved, -1) / 2e-3
    assert ((gradient - differences).abs().amax(-1) < 0.05).float().mean() > 0.97  # but for edges


def test_a_removal_leaves_the_room() -> None:
    T, empty = turned(), room()
    for removal in (
        Removal(obj=stool(T), T_object_scene=T),
        Removal(detection=OrientedBox.from_corners([-0.22, -0.22, -0.01], [0.22, 0.22, 0.38])),
    ):
        edited = compose(room(*STOOL), [removal])
        points = free_points()
        assert ((edited.signed_distance(points) > 0) == (empty.signed_distance(points) > 0)).all()
        above = torch.cartesian_prod(torch.linspace(-0.7, 0.7, 40), torch.linspace(-0.7, 0.7, 40), torch.tensor([4e-3]))
        distance, gradient = edited.signed_distance_and_gradient(above)
        assert (distance - 4e-3).abs().max() < 1.5e-3  # the floor goes on where legs stood, without a seam
        assert (gradient[:, 2] > 0.98).all()
        below = above * torch.tensor([1.0, 1.0, -1.0])
        assert (edited.signed_distance(below) < 0).all()


def test_a_thing_at_a_wall_leaves_floor_and_wall() -> None:
    thing = ([-0.9, -0.15, 0.0], [-0.6, 0.15, 0.5])
    detection = OrientedBox.from_corners([-0.9, -0.16, 0.0], [-0.59, 0.16, 0.51])
    edited = compose(room(thing), [Removal(detection=detection)])
    points = torch.cartesian_prod(torch.tensor([-0.895]), torch.linspace(-0.5, 0.5, 25), torch.linspace(0.02, 0.9, 25))
    assert (edited.signed_distance(points) - 5e-3).abs().max() < 2e-3
    assert (edited.signed_distance(points - torch.tensor([0.01, 0.0, 0.0])) < 0).all()


def test_what_reaches_in_from_outside_stays() -> None:
    top = ([-0.9, -0.5, 0.5], [0.8, 0.1, 0.56])
    T = turned()
    tall = [*STOOL, ([-0.2, -0.2, 0.36], [-0.15, -0.15, 0.48])]  # its box reaches the table's top
    scene = room(*tall, top)
    here = boxes(tall, BOUNDS)
    frame = stool(T)
    obj = AnalyticField(lambda y: SCALE * here.formula(T.inverse().apply(y)), frame.bounds.tolist())
    edited = compose(scene, [Removal(obj=obj, T_object_scene=T)])
    inside = torch.cartesian_prod(torch.linspace(-0.8, 0.7, 30), torch.linspace(-0.4, 0.0, 20), torch.tensor([0.53]))
    assert (edited.signed_distance(inside) < 0).all()
    seat = torch.cartesian_prod(torch.linspace(-0.18, 0.18, 9), torch.linspace(-0.18, 0.18, 9), torch.tensor([0.33]))
    assert (edited.signed_distance(seat) > 0).all()


def test_a_table_ends_where_it_ended() -> None:
    """A thing at a table's edge: no floor is continued beyond the edge."""
    top = ([-0.5, -0.5, 0.4], [0.0, 0.5, 0.45])
    vase = ([-0.2, -0.1, 0.45], [-0.02, 0.1, 0.7])
    scene = room(top, vase)
    edited = compose(scene, [Removal(detection=OrientedBox.from_corners([-0.21, -0.11, 0.45], [0.1, 0.11, 0.71]))])
    on = torch.cartesian_prod(torch.linspace(-0.45, -0.03, 20), torch.linspace(-0.4, 0.4, 20), torch.tensor([0.446]))
    assert (edited.signed_distance(on) < 0).all()
    beyond = torch.cartesian_prod(
        torch.linspace(0.02, 0.3, 10), torch.linspace(-0.3, 0.3, 10), torch.tensor([0.44, 0.45, 0.46])
    )
    assert (edited.signed_distance(beyond) > 0).all()
    above = on + torch.tensor([0.0, 0.0, 0.02])
    assert (edited.signed_distance(above) > 0).all()


def test_a_replacement_stands_on_the_same_base() -> None:
    T = turned()
    ball = sphere(3.0, bounds=[[-4.0] * 3, [4.0] * 3])
    edited = compose(room(*STOOL), [Replacement(stool(T), T, ball)])
    low, high = edited.objects[0][1].bounds
    assert abs(float(low[2])) < 0.02  # the floor
    assert abs(float(high[2]) - 0.36) < 0.03  # as high as the stool
    known = Sim3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.log(4.0)], dtype=torch.float64))
    given = compose(room(*STOOL), [Replacement(stool(T), T, ball, known)]).objects[0][1].T_object_scene
    assert torch.allclose(given.matrix(), (known @ T).matrix())


def test_standing_alike_maps_base_to_base_and_up_to_up() -> None:
    here = OrientedBox.from_corners([-1, -2, 0], [1, 2, 5])
    other = OrientedBox.from_corners([-1, -10, 0], [3, 0, 4])  # its vertical is -y
    T = standing_alike(here, other, "z", "-y")
    assert torch.allclose(T.apply(torch.tensor([[0.0, 0.0, 0.0]]).double()), torch.tensor([[1.0, 0.0, 2.0]]).double())
    assert torch.allclose(T.apply(torch.tensor([[0.0, 0.0, 5.0]]).double()), torch.tensor([[1.0, -10.0, 2.0]]).double())
    assert float(T.scale) == pytest.approx(2.0)


def test_parts_tell_whose_the_surface_is() -> None:
    T = turned()
    edited = compose(room(), [Insertion(stool(T), T, tint=(1.0, 0.0, 0.0), name="stool")])
    frame = render(edited, Camera.look_at([0.8, 0.7, 0.8], [0.0, 0.0, 0.2], (48, 36)), RenderOptions())
    seat = frame.part == 1
    assert seat.sum() > 50
    assert (frame.part[~seat & (frame.depth > 0)] == SCENE_PART).all()
    assert (frame.color[seat][:, 0] > 3 * frame.color[seat][:, 1].astype(int)).all()
    assert edited.parts[1].name == "stool"


def test_the_rim_round_what_stands_on_an_object_is_the_objects() -> None:
    """A neighbor keeps a rim of the scene's copy, here one that lies a little higher than the object."""
    T = turned()
    lid = ([-0.2, -0.2, 0.3], [0.2, 0.2, 0.361])
    edited = compose(room(*STOOL, lid, ([-0.05, -0.05, 0.361], [0.05, 0.05, 0.6])), [Substitution(stool(T), T)])
    axis = torch.linspace(-0.19, 0.19, 77)
    top = torch.cartesian_prod(axis, axis, torch.tensor([0.361]))
    top = top[top[:, :2].abs().amax(1) > 0.056]
    assert int((edited.signed_distance(top).abs() < 1e-4).sum()) > 20, "or no rim was kept"
    assert set(edited.part_at(top).tolist()) == {1}
    assert edited.part_at(torch.tensor([[0.05, 0.0, 0.5]])).tolist() == [SCENE_PART]


@pytest.mark.parametrize("ball_first", [True, False])
def test_objects_that_touch_keep_their_own_surfaces(ball_first: bool) -> None:
    T, on_top = turned(), Sim3.from_matrix(torch.eye(4, dtype=torch.float64))
    ball = sphere(0.05, center=(0.0, 0.0, 0.41), bounds=[[-0.1, -0.1, 0.3], [0.1, 0.1, 0.5]])
    edits = [Insertion(ball, on_top), Insertion(stool(T), T)]
    edited = compose(room(), edits if ball_first else edits[::-1])
    low = torch.tensor([[0.0, -0.008, 0.3606], [0.0, 0.008, 0.3606]])  # on the ball, .0006 above the stool
    assert set(edited.part_at(low).tolist()) == {1 if ball_first else 2}


def test_an_edited_scene_is_edited_again() -> None:
    T = turned()
    once = compose(room(*STOOL), [Removal(obj=stool(T), T_object_scene=T)])
    ball = sphere(0.2, bounds=[[-0.3] * 3, [0.3] * 3])
    place = Sim3.from_translation(torch.tensor([-0.3, -0.3, -0.21], dtype=torch.float64))
    twice = compose(once, [Insertion(ball, place)])
    exact = union([room(), sphere(0.2, (0.3, 0.3, 0.21))], BOUNDS)
    points = free_points()
    truth = exact.signed_distance(points)
    assert ((twice.signed_distance(points) > 0) == (truth > 0))[truth.abs() > 2e-3].all()
    assert len(twice.parts) == 3


def test_what_objects_say_outside_of_their_bounds_counts_for_nothing() -> None:
    """Trained fields mean nothing there: this one has a second ball beyond them."""
    ghost = union([BALL, sphere(0.2, (0.0, 0.0, 0.9))], [[-0.3] * 3, [0.3] * 3])
    T = Sim3.from_translation(torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64))
    edited = compose(room(), [Insertion(ghost, T)])
    points = free_points()
    exact = union([room(), sphere(0.2, (0.0, 0.0, 0.2))], BOUNDS).signed_distance(points)
    assert ((edited.signed_distance(points) > 0) == (exact > 0))[exact.abs() > 2e-3].all()


SHEARED = [[1.0, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
FAR = Sim3.from_translation(torch.tensor([50.0, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("reason", "make"),
    [
        ("INVALID_TRANSFORM", lambda: Substitution(BALL, Sim3.from_matrix(SHEARED))),
        ("INVALID_TRANSFORM", lambda: Insertion(BALL, Sim3.identity()[None].expand(2))),
        (
            "INVALID_TRANSFORM",
            lambda: Insertion(
                BALL, Sim3(torch.tensor(torch.nan).double(), torch.eye(3).double(), torch.zeros(3).double())
            ),
        ),
        ("EDIT_INVALID", lambda: Removal()),
        ("EDIT_INVALID", lambda: Removal(obj=BALL)),
        ("EDIT_INVALID", lambda: Substitution(BALL, Sim3.identity(), residual=-1.0)),
        (
            "EDIT_INVALID",
            lambda: compose(room(), [Replacement(BALL, Sim3.identity(), BALL, up_object="up")]),
        ),
        ("EDIT_INVALID", lambda: compose(room(), [Insertion(BALL, FAR)])),
        ("EDIT_INVALID", lambda: compose(room(*STOOL), [Removal(obj=stool(turned()), T_object_scene=turned())] * 2)),
        ("EDIT_INVALID", lambda: compose(room(), [Insertion(stool(turned()), turned())] * 2)),
    ],
)
def test_bad_edits_have_reasons(reason: str, make: Callable[[], object]) -> None:
    with pytest.raises(RegnfError) as caught:
        make()
    assert caught.value.reason == reason


def test_an_object_without_surface() -> None:
    empty = AnalyticField(lambda p: p.norm(dim=-1) + 5.0, [[-1.0] * 3, [1.0] * 3])
    with pytest.raises(NoSurfaceError, match="edit 0") as caught:
        compose(room(), [Insertion(empty, Sim3.identity())])
    assert caught.value.reason == "NO_SURFACE_IN_OBJECT"


def test_matter_that_nobody_saw_goes() -> None:
    """A ball of which only the upper half was measured, in a turned and scaled grid: a shell of it is left."""
    states = torch.zeros(40, 40, 40, dtype=torch.uint8)
    T_grid_frame = Sim3.exp(torch.tensor([0.0, 0.0, 0.3, 1.0, 2.0, 3.0, np.log(2.0)], dtype=torch.float64))
    low, voxel = T_grid_frame.apply(torch.zeros(1, 3).double())[0] - 2.0, 0.1
    index = torch.cartesian_prod(*(torch.arange(40),) * 3)
    at = T_grid_frame.inverse().apply(low + voxel * (index + 0.5))
    measured = ((at.norm(dim=-1) - 0.5).abs() < 0.05) & (at[:, 2] > 0.0)
    states.view(-1)[measured] = SURFACE
    ball = ObservedField(sphere(0.5), Observation(states, low, voxel, T_grid_frame))
    shell = without_unseen(ball)
    points = torch.tensor([[0.0, 0.0, 0.48], [0.0, 0.0, 0.52], [0.0, 0.0, -0.48], [0.0, 0.0, 0.0]])
    assert (shell.signed_distance(points) > 0).tolist() == [False, True, True, True]
    distance, gradient = shell.signed_distance_and_gradient(points[:2])
    assert torch.allclose(distance, torch.tensor([-0.02, 0.02]), atol=1e-4)
    assert (gradient[:, 2] > 0.99).all()
    assert isinstance(without_unseen(sphere(0.5)), AnalyticField)


UTM = torch.tensor([448_262.25, 5_413_920.5, 112.0], dtype=torch.float64)


def far(field: SdfField) -> SdfField:
    """The field at ``UTM``, as an import places it."""
    return TransformedField(field, Sim3.from_translation(-UTM))


def edits_at(shift: torch.Tensor) -> list[Edit]:
    """A removal and an insertion in the room of ``room``, from whose places ``shift`` was added."""
    back = Sim3.from_translation(-shift)
    gone = OrientedBox.from_corners([-0.22, -0.22, -0.01], [0.22, 0.22, 0.38]).shifted(shift)
    T = turned() @ Sim3.from_translation(torch.tensor([-0.5, 0.4, 0.0], dtype=torch.float64)) @ back
    return [Removal(detection=gone), Insertion(stool(turned()), T, tint=(0.9, 0.1, 0.1))]


def observed_room() -> ObservedField:
    states = torch.full((20, 20, 11), SURFACE, dtype=torch.uint8)
    return ObservedField(room(*STOOL), Observation(states, torch.tensor([-1.0, -1.0, -0.1]).double(), 0.1))


def test_a_scene_far_from_the_origin_is_edited_as_the_same_one_near_it(tmp_path: Path) -> None:
    scene = observed_room()
    near, there = compose(scene, edits_at(torch.zeros(3).double())), compose(far(scene), edits_at(UTM))
    points = free_points().double()
    distance, gradient = near.signed_distance_and_gradient(points)
    moved, slope = there.signed_distance_and_gradient(points + UTM)
    torch.testing.assert_close(moved, distance, atol=2e-6, rtol=0.0)
    assert ((slope - gradient).abs().amax(-1) < 1e-3).float().mean() > 0.99  # but for edges
    assert torch.equal(there.part_at(points + UTM), near.part_at(points))
    torch.testing.assert_close(there.places[1].center, near.places[1].center + UTM, atol=1e-8, rtol=0.0)
    torch.testing.assert_close(there.bounds, near.bounds + UTM, atol=1e-8, rtol=0.0)
    assert near.observation is not None
    assert there.observation is not None
    assert torch.equal(there.observation.at(points + UTM), near.observation.at(points))
    for field, name in ((near, "near"), (there, "far")):
        write_field(field, tmp_path / name, 40)
    stored, stored_far = open_field(tmp_path / "near"), open_field(tmp_path / "far")
    torch.testing.assert_close(
        stored_far.signed_distance(points + UTM), stored.signed_distance(points), atol=2e-6, rtol=0
    )
    kept = observation_of(stored_far)
    assert kept is not None
    assert torch.equal(kept.at(points + UTM), near.observation.at(points))


def test_an_edited_scene_far_from_the_origin_is_rendered_with_its_parts_and_edited_again() -> None:
    frames = []
    for scene, shift in ((room(*STOOL), torch.zeros(3).double()), (far(room(*STOOL)), UTM)):
        edited = compose(scene, edits_at(shift))
        again = compose(
            edited, [Insertion(sphere(0.1), Sim3.from_translation(-shift - torch.tensor([-0.4, -0.4, 0.1])))]
        )
        place = torch.tensor([0.9, -0.9, 0.7]).double() + shift
        camera = Camera.look_at(place, shift + torch.tensor([0.2, -0.2, 0.2]), (48, 36), 60.0)
        frames.append(render(again, camera, RenderOptions(tints=True, cut_away=True)))
    near, there = frames
    assert len(np.unique(near.part)) >= 3
    assert (near.part == there.part).mean() > 0.99
    assert np.median(np.abs(near.depth - there.depth)) < 1e-5
    assert (np.abs(near.color.astype(int) - there.color).max(-1) < 4).mean() > 0.98


# Edited scenes as files.

RED, BLUE = torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8])
RADIUS = 0.4


class TwoColored(AnalyticField):
    """A ball, red where z is positive and blue elsewhere, and black where it is not seen from straight before."""

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        straight = -(torch.nn.functional.normalize(points, dim=-1) * directions).sum(-1) > 0.99
        halves = torch.where(points[:, 2:] > 0.0, RED, BLUE)
        return torch.where(straight[:, None], halves, 0.0)

    inverse_deviation = None


def ball() -> TwoColored:
    made = sphere(RADIUS)
    return TwoColored(made.formula, made.bounds.tolist())


def on_the_ball(count: int = 500) -> Tensor:
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    points = RADIUS * torch.nn.functional.normalize(directions, dim=-1)
    return points[points[:, 2].abs() > 0.1]  # off the border between the halves


@pytest.mark.parametrize("edited", [False, True])
def test_a_field_keeps_its_colors(edited: bool, tmp_path: Path) -> None:
    field, at = ball(), on_the_ball()
    if edited:
        T = Sim3.exp(torch.tensor([0.4, 0.0, 0.0, 0.1, -0.05, 0.02, 0.3], dtype=torch.float64))
        back = T.inverse()
        scene = sphere(float(RADIUS / T.scale), back.apply(torch.zeros(1, 3).double())[0].tolist())
        field, at = compose(scene, [Substitution(field, T)]), back.apply(at.double()).float()
    write_field(field, tmp_path / "f.safetensors", 48)
    stored = open_field(tmp_path / "f.safetensors")
    assert has_color(stored)
    expected = torch.where(on_the_ball()[:, 2:] > 0.0, RED, BLUE)
    found = stored.color(at, torch.zeros_like(at))
    assert (found - expected).abs().max() < 0.01
    assert stored.signed_distance(at).abs().max() < 0.02


def test_a_field_without_colors_stays_without(tmp_path: Path) -> None:
    write_field(sphere(RADIUS), tmp_path / "f.safetensors", 16)
    assert not has_color(open_field(tmp_path / "f.safetensors"))
