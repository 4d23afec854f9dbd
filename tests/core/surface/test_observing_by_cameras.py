"""What cameras observed of a field, by where they stood: against every voxel projected into every camera."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.solids import BoxField, UnionField
from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import Observation
from regnf_core.geometry.pinhole import PinholeCameras
from regnf_core.importing.observing.trajectory import Array, Axes, Intrinsics, Trajectory, trajectory_of
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_core.surface.observing import observe_by_cameras

POINTS = 1_500_000


def room() -> UnionField:
    """A floor, a wall, and a block that stands on the floor and hides a part of both."""
    boxes = [
        ((-1.0, -1.0, -0.5), (1.0, 1.0, -0.4)),
        ((-1.0, 0.9, -0.5), (1.0, 1.0, 0.5)),
        ((-0.3, 0.1, -0.4), (0.2, 0.5, 0.1)),
    ]
    return UnionField([BoxField(*box) for box in boxes])


def looking(positions: Tensor, target: Tensor, half_angle: float = 0.6, aspect: float = 1.4) -> PinholeCameras:
    forward = torch.nn.functional.normalize(target - positions, dim=-1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]).double().expand_as(forward)), dim=-1
    )
    axes = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
    f = 0.5 / math.tan(half_angle)
    n = len(positions)
    return PinholeCameras(
        positions,
        axes,
        torch.tensor([[f, f * aspect]]).double().repeat(n, 1),
        torch.full((n, 2), 0.5).double(),
        torch.full((n,), aspect).double(),
    )


def walk(count: int) -> PinholeCameras:
    angle = torch.linspace(-0.7, 0.5, count, dtype=torch.float64)
    positions = torch.stack([0.85 * angle.sin(), -0.85 * angle.cos(), 0.1 + 0.1 * angle], 1)
    return looking(positions, torch.tensor([0.0, 0.2, -0.3]).double())


def slowly_free(field: UnionField, cameras: PinholeCameras, points: Tensor, close: float) -> Tensor:
    """(N,) bool: whether small steps from a camera come to within ``close`` of each point without meeting matter."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for camera in range(len(cameras)):
        local = (points.double() - cameras.positions[camera]) @ cameras.axes[camera]
        at = local[:, :2] / local[:, 2:] * cameras.focal[camera] + cameras.middle[camera]
        shown = (local[:, 2] > 0) & (at > 0).all(1) & (at < 1).all(1) & ~found
        for index in shown.nonzero()[:, 0]:
            way = points[index].double() - cameras.positions[camera]
            reach = float(way.norm()) - close
            steps = torch.arange(0.0, reach, 0.01, dtype=torch.float64)[:, None] / way.norm()
            found[index] = bool((field.signed_distance((cameras.positions[camera] + steps * way).float()) > 0).all())
    return found


@pytest.fixture(scope="module")
def observation() -> Observation:
    return observe_by_cameras(room(), walk(9), POINTS)[0]


def middles(observation: Observation, index: Tensor) -> Tensor:
    return (observation.low + (index + 0.5) * observation.voxel).float()


def drawn(observation: Observation, state: int, count: int, seed: int = 0) -> Tensor:
    index = (observation.states == state).nonzero()
    return index[torch.randperm(len(index), generator=torch.Generator().manual_seed(seed))[:count]]


def test_what_is_free_was_looked_through(observation: Observation) -> None:
    points = middles(observation, drawn(observation, FREE, 80))
    field = room()
    assert bool((field.signed_distance(points) > 0).all())
    assert float(slowly_free(field, walk(9), points, 0.0).float().mean()) >= 0.99


def test_what_is_unobserved_was_not_looked_through_but_for_borders(observation: Observation) -> None:
    points = middles(observation, drawn(observation, UNSEEN, 80))
    field = room()
    far = field.signed_distance(points).abs() > 2.0 * observation.voxel
    assert float(slowly_free(field, walk(9), points[far], 0.0).float().mean()) <= 0.06


def test_observed_surface_is_where_a_line_of_sight_ends(observation: Observation) -> None:
    index = drawn(observation, SURFACE, 80)
    field, points = room(), middles(observation, index)
    distance, gradient = field.signed_distance_and_gradient(points)
    on = points - distance[:, None] * gradient
    assert float(distance.abs().max()) <= 1.2 * observation.voxel
    assert float(slowly_free(field, walk(9), on, observation.voxel).float().mean()) >= 0.97


def test_surface_that_a_line_of_sight_leads_to_is_observed(observation: Observation) -> None:
    field = room()
    generator = torch.Generator().manual_seed(1)
    points = 2.0 * torch.rand(40_000, 3, generator=generator) - 1.0
    distance, gradient = field.signed_distance_and_gradient(points)
    points = (points - distance[:, None] * gradient)[distance.abs() < 0.2]
    points = points[field.signed_distance(points).abs() < 1e-4][:250]
    seen = slowly_free(field, walk(9), points, 0.02)
    states = observation.at(points)
    assert int(seen.sum()) > 50
    assert int((~seen).sum()) > 50
    assert float((states[seen] == SURFACE).float().mean()) >= 0.97
    assert float((states[~seen] == SURFACE).float().mean()) <= 0.1


def test_fewer_evaluations_make_larger_voxels(observation: Observation) -> None:
    coarse, again = (observe_by_cameras(room(), walk(9), 100_000)[0] for _ in range(2))
    assert coarse.voxel > 1.5 * observation.voxel
    assert torch.equal(coarse.states, again.states)
    assert torch.equal(coarse.low, again.low)
    points = middles(coarse, drawn(coarse, FREE, 80))
    assert float(slowly_free(room(), walk(9), points, 0.0).float().mean()) >= 0.97


@pytest.mark.parametrize("shift", [(0.0, 0.0, -0.55), (30.0, 0.0, 0.0)])
def test_cameras_in_matter_or_far_away_are_of_another_frame(shift: tuple[float, float, float]) -> None:
    cameras = walk(5)
    moved = PinholeCameras(
        cameras.positions + torch.tensor(shift).double(), cameras.axes, cameras.focal, cameras.middle, cameras.aspect
    )
    with pytest.raises(FieldFormatError) as raised:
        observe_by_cameras(room(), moved, 100_000)
    assert raised.value.reason == "CAMERAS_OF_ANOTHER_FRAME"


def test_a_similarity_moves_cameras_as_it_moves_points() -> None:
    cameras = walk(3)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = 2.5 * turn, torch.tensor([1.0, -2.0, 0.5])
    points = 0.5 * torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    places, depth = cameras.project(1, points)
    moved_places, moved_depth = cameras.moved(transform).project(1, points @ transform[:3, :3].T + transform[:3, 3])
    assert torch.allclose(places, moved_places)
    assert torch.allclose(2.5 * depth, moved_depth)
    rays = cameras.directions(1, places)
    assert torch.allclose(cameras.positions[1] + depth[:, None] * rays, points)


def trajectory(cameras: PinholeCameras, axes: Axes, change: Callable[[Array], Array]) -> Trajectory:
    """The cameras of a file that was read by ``axes``, and whose matrices are those of ``cameras`` but for a change."""
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = cameras.axes.numpy(), cameras.positions.numpy()
    K = Intrinsics(float(cameras.focal[0, 0]), float(cameras.focal[0, 1]), 0.5, 0.5, 1.0, 1.0)
    return trajectory_of("poses", change(poses), K, axes)


def as_w_first(poses: Array) -> Array:
    """What poses become whose quaternions are written as w x y z and read as x y z w."""
    changed = poses.copy()
    w_first = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    changed[:, :3, :3] = Rotation.from_quat(w_first).as_matrix()
    return changed


HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
FORWARD_X = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
MISREAD: dict[str, tuple[Axes, Callable[[Array], Array], str]] = {
    "OpenGL": ("opencv", lambda T: T @ HALF_TURN, "against z.*give --camera-axes opengl"),
    "OpenCV": ("opengl", lambda T: T, "along z.*give --camera-axes opencv"),
    "inverted": ("opencv", np.linalg.inv, "world to the camera: invert the matrices"),
    "inverted, OpenGL": ("opengl", lambda T: np.linalg.inv(T @ HALF_TURN), "world to the camera: invert the matrices"),
    "inverted, OpenGL read as OpenCV": ("opencv", lambda T: np.linalg.inv(T @ HALF_TURN), "invert.*and give --camera"),
    "a body": ("opencv", lambda T: T @ FORWARD_X, "along x .*rotate the axes of the cameras"),
}


def others(read: Trajectory) -> list[tuple[str, PinholeCameras]]:
    return [(f"{name}: {mend}", other.pinhole()) for name, mend, other in read.otherwise()]


@pytest.mark.parametrize("name", list(MISREAD))
def test_the_convention_that_the_field_agrees_with_is_named(name: str) -> None:
    axes, change, told = MISREAD[name]
    read = trajectory(walk(9), axes, change)
    try:
        _, said = observe_by_cameras(room(), read.pinhole(), 100_000, others(read))
    except FieldFormatError as error:  # most of them see nothing
        said = str(error)
    assert re.search(told, said or "")


def test_quaternions_in_another_order_are_tried() -> None:
    right, read = walk(9), trajectory(walk(9), "opencv", as_w_first)
    mended = dict(others(read))["quaternions with w first: write quaternions as x y z w"]
    torch.testing.assert_close(mended.axes, right.axes, atol=1e-9, rtol=0.0)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_right_cameras_are_taken_without_a_word(count: int) -> None:
    read = trajectory(walk(count), "opengl", lambda T: T @ HALF_TURN)
    _, doubt = observe_by_cameras(room(), read.pinhole(), 100_000, others(read))
    assert doubt is None
