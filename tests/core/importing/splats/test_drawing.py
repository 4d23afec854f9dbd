"""The depths that are drawn of Gaussian splats, against a slow reference and against planes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnf_core.importing.observing.trajectory import Intrinsics, trajectory_of
from regnf_core.importing.splats import drawing
from regnf_core.importing.splats.drawing import Camera, depth_image, prepared
from regnf_core.importing.splats.gaussians import Doubles, Splats
from regnf_core.importing.splats.views import Seen, agreed, cameras_for, given_cameras, region_of
from regnf_core.native.library import variant

LAYER = 0.01
CAMERA = Camera(np.eye(4), (30.0, 32.0), (16.0, 12.0), (32, 24))


def random_splats(count: int, seed: int) -> Splats:
    random = np.random.default_rng(seed)
    turns = np.roll(Rotation.random(count, rng=random).as_quat(), 1, axis=1)
    return Splats(
        random.uniform([-1, -1, 1.5], [1, 1, 4], (count, 3)),
        np.log(random.uniform(0.02, 0.4, (count, 3))).astype(np.float32),
        turns.astype(np.float32),
        random.uniform(0.05, 1.0, count).astype(np.float32),
        random.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )


def plane(normal: Doubles, distance: float, seed: int = 0, opacity: float = 0.95) -> Splats:
    """Flat splats that cover the plane normal . x = distance around the z axis."""
    normal = np.array(normal) / np.linalg.norm(normal)
    random, turn = np.random.default_rng(seed), Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0]
    local = np.column_stack([random.uniform(-4, 4, (40_000, 2)), np.zeros(40_000)])
    rotations = np.tile(np.roll(turn.as_quat(), 1), (len(local), 1)).astype(np.float32)
    scales = np.log(np.tile([0.05, 0.05, 0.001], (len(local), 1))).astype(np.float32)
    means = turn.apply(local) + distance * normal
    return Splats(
        means, scales, rotations, np.full(len(local), opacity, np.float32), np.zeros((len(local), 1, 3), "f4")
    )


def slow_depth(splats: Splats, column: int, row: int) -> float:
    """One pixel, one splat after the other, by the formulas of the 3DGS and the Mip-Splatting paper."""
    focal, light, half = np.array(CAMERA.focal), 1.0, 0.0
    taken = []
    for index in np.argsort(splats.means[:, 2], kind="stable"):
        x, y, z = splats.means[index]
        own = splats.axes()[index] * np.exp(splats.scales[index])
        covariance = own @ own.T
        J = np.array([[focal[0] / z, 0, -focal[0] * x / z**2], [0, focal[1] / z, -focal[1] * y / z**2]])
        plain = J @ covariance @ J.T
        blurred = plain + 0.3 * np.eye(2)
        opacity = splats.opacities[index] * np.sqrt(np.linalg.det(plain) / np.linalg.det(blurred))
        center = focal * [x / z, y / z] + CAMERA.middle
        if opacity <= 1 / 64 or (np.abs(center - np.array(CAMERA.size) / 2) >= 1.3 * np.array(CAMERA.size) / 2).any():
            continue
        off = np.array([column + 0.5, row + 0.5]) - center
        alpha = min(opacity * np.exp(-0.5 * off @ np.linalg.solve(blurred, off)), 0.99)
        if alpha <= 1 / 64:
            continue
        slope = np.linalg.solve(plain + 0.01 * np.trace(plain) * np.eye(2), J @ covariance[:, 2])
        depth = max(z + slope @ off, 0.5 * z)
        taken.append((depth, alpha))
        if light >= 0.5 > light * (1.0 - alpha):
            half = depth
        light *= 1.0 - alpha
    weights = [alpha * np.exp(-0.5 * ((depth - half) / LAYER) ** 2) for depth, alpha in taken]
    return float(np.dot(weights, [depth for depth, _ in taken]) / sum(weights)) if half else 0.0


@pytest.mark.parametrize(("at_once", "compiled"), [(1 << 21, False), (500, False), (0, True)])
def test_each_pixel_is_that_of_a_slow_reference(at_once: int, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if compiled and variant() is None:
        pytest.skip("the compiled code was not built")
    if not compiled:
        monkeypatch.setattr(drawing, "variant", lambda: None)
        monkeypatch.setattr(drawing, "_FRAGMENTS", at_once)
    splats = random_splats(300, 1)
    depth, _ = depth_image(prepared(splats), CAMERA, LAYER)
    random = np.random.default_rng(0)
    for column, row in zip(random.integers(32, size=60), random.integers(24, size=60), strict=True):
        assert depth[row, column] == pytest.approx(slow_depth(splats, int(column), int(row)), rel=1e-3)


def test_compiled_code_draws_what_arrays_do(monkeypatch: pytest.MonkeyPatch) -> None:
    if variant() is None:
        pytest.skip("the compiled code was not built")
    splats = prepared(random_splats(3000, 2))
    depth, color = depth_image(splats, CAMERA, LAYER)
    monkeypatch.setattr(drawing, "variant", lambda: None)
    expected, shown = depth_image(splats, CAMERA, LAYER)
    assert (depth > 0).all()
    np.testing.assert_allclose(np.quantile(np.abs(depth - expected), 0.99), 0.0, atol=1e-4)
    assert np.abs(color.astype(int) - shown).max() <= 1


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.4, 0, 1), (0, -0.7, 1), (0.5, 0.5, 0.8)])
def test_a_plane_of_flat_splats_has_its_own_depths(normal: Doubles) -> None:
    depth, _ = depth_image(prepared(plane(normal, 2.0)), CAMERA, LAYER)
    column, row = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    rays = np.stack([(column - 16) / 30, (row - 12) / 32, np.ones_like(row)], axis=-1)
    expected = 2.0 / (rays @ (np.array(normal) / np.linalg.norm(normal)))
    seen = depth > 0
    assert seen.mean() > 0.95
    assert np.median(np.abs(depth - expected)[seen] / expected[seen]) < 0.004
    assert np.quantile(np.abs(depth - expected)[seen] / expected[seen], 0.98) < 0.03


def test_faint_splats_in_front_are_looked_through_and_colors_are_theirs() -> None:
    front, back = plane((0, 0, 1), 1.0, opacity=0.02), plane((0, 0, 1), 2.0)
    front = front.chosen(slice(0, 400))
    back = replace(back, harmonics=np.full((len(back), 1, 3), 1.0, np.float32))
    both = Splats.together([front, back])
    depth, color = depth_image(prepared(both), CAMERA, LAYER)
    assert np.median(depth) == pytest.approx(2.0, rel=0.01)
    assert np.median(color) == pytest.approx(255 * (0.5 + 0.282), abs=4)


def ring_depth(camera: Camera, radius: float) -> Seen:
    """What a camera sees of a sphere at the origin."""
    width, height = camera.size
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(camera.matrix).T
    middle = camera.T_camera_world[:3, 3]
    b, a = rays @ middle, (rays**2).sum(axis=-1)
    under = b**2 - a * (middle @ middle - radius**2)
    depth = np.where(under > 0, (b - np.sqrt(np.maximum(under, 0))) / a, 0.0)
    return Seen(camera, depth.astype(np.float32), np.zeros((height, width, 3), np.uint8))


def test_depths_that_other_views_see_through_are_left_out() -> None:
    region = region_of(sphere(2000), None, within=False)
    views = [ring_depth(camera, 1.0) for camera in cameras_for(sphere(2000), region)]
    good, share = agreed(views, 0.01, alone=True, placed=True)
    assert share < 0.01
    wrong = views[0].depth.copy()
    wrong[100:140, 100:140] -= 0.5  # as of a floater before one camera
    left, _ = agreed([replace(views[0], depth=wrong), *views[1:]], 0.01, alone=True, placed=True)
    assert (left[0].depth[102:138, 102:138] == 0).mean() > 0.95
    outside = np.ones(wrong.shape, bool)
    outside[95:145, 95:145] = False
    np.testing.assert_array_equal(left[0].depth[outside], good[0].depth[outside])


def plate_depth(place: Doubles) -> Seen:
    """What a camera at a place sees of the square |x|, |y| < 1 at z = 0, towards its middle."""
    camera = replace(CAMERA, T_camera_world=looking(np.array(place)), focal=(40.0, 40.0))
    rays = Seen(camera, np.ones((24, 32), np.float32), np.zeros((24, 32, 3), np.uint8)).ends() - place
    depth = -place[2] / rays[..., 2]
    ends = place + depth[..., None] * rays
    on = (np.abs(ends[..., :2]) < 1.0).all(axis=-1) & (depth > 0.0)
    return Seen(camera, np.where(on, depth, 0.0).astype(np.float32), np.zeros((24, 32, 3), np.uint8))


def looking(place: Doubles) -> Doubles:
    ahead = -place / np.linalg.norm(place)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    T[:3, 3] = -T[:3, :3] @ place
    return T


@pytest.mark.parametrize(("placed", "alone"), [(True, True), (True, False), (False, False)])
def test_what_is_seen_from_behind_tells_nothing(placed: bool, alone: bool) -> None:
    """A plate that three views see from above and one from below: where there is nothing to see from, it is left out.
    Cameras of the training did look from there."""
    above = [plate_depth(np.array([x, 0.1, 2.0])) for x in (-0.5, 0.0, 0.6)]
    below = plate_depth(np.array([0.2, 0.1, -1.5]))
    views, _ = agreed([*above, below], 0.01, alone, placed)
    for before, after in zip(above, views[:3], strict=True):
        np.testing.assert_array_equal(after.depth, before.depth)
    seen = below.depth > 0.0
    assert seen.mean() > 0.5
    if not placed:
        np.testing.assert_array_equal(views[3].depth, below.depth)
    elif alone:
        assert np.isnan(views[3].depth[seen]).all()
        ahead = views[3].ahead(np.zeros(1), np.zeros(1), np.array([-0.5, 0.5]))
        assert np.isnan(ahead).all()
    else:
        assert len(views) == 3  # no camera was at a place that sees backs alone


def sphere(count: int, radius: float = 1.0, seed: int = 0) -> Splats:
    random = np.random.default_rng(seed)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turns = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    wide = 2.0 * radius / np.sqrt(count)
    scales = np.log(np.tile([wide, wide, wide / 20], (count, 1))).astype(np.float32)
    colors = np.zeros((count, 1, 3), np.float32)
    return Splats(radius * normals, scales, turns.astype(np.float32), np.full(count, 0.9, np.float32), colors)


def test_the_region_holds_what_is_dense_and_knows_a_room_from_an_object() -> None:
    shell, random = sphere(20_000), np.random.default_rng(1)
    far = shell.chosen(slice(0, 400))
    far = replace(far, means=random.uniform(-30, 30, (400, 3)))
    both = Splats.together([shell, far])
    region = region_of(both, None, None)
    np.testing.assert_allclose([region.low, region.high], [[-1] * 3, [1] * 3], atol=0.4)
    assert not region.within
    assert len(cameras_for(both, region)) == 40
    assert len(cameras_for(both, replace(region, within=True))) % 6 == 0


def test_cameras_that_came_with_the_splats_are_moved_into_their_frame() -> None:
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 2.0, 3.0]
    known = trajectory_of("cameras.json", pose[None], Intrinsics(100, 100, 50, 40, 100, 80), None)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = 2.0 * np.diag([1.0, -1.0, -1.0]), [0.5, 0.0, 0.0]
    camera = given_cameras(known, T)[0]
    place = np.linalg.inv(camera.T_camera_world)[:3, 3]
    np.testing.assert_allclose(T[:3, :3] @ place + T[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(camera.T_camera_world[:3, :3] @ camera.T_camera_world[:3, :3].T, np.eye(3), atol=1e-12)
    assert camera.size[0] / camera.size[1] == pytest.approx(1.25, abs=0.01)
