"""Frames against closed forms: rays and solids whose meeting is known exactly."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_core import Camera, RegnfError, RenderOptions, render
from regnf_core.errors import CancelledError, InvalidInputError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.processes import can_fork
from regnf_core.rendering.camera import NOTHING, orbit_cameras
from regnf_core.rendering.render import free_start, render_frames
from regnf_core.rendering.request import OrbitRequest
from regnf_core.rendering.tracing import DistanceGrid, Region, Start
from regnf_core.surface.sphere_tracing import Rays
from tests.core.analytic import AnalyticField, boxes, sphere

SIZE = (48, 36)
CAMERA = Camera.look_at([0.9, -0.7, 0.6], [0.05, 0.0, 0.02], SIZE, 40.0)
MODES = ("surface", "volume")
BOX = OrientedBox.from_corners([-0.3] * 3, [0.3] * 3)


def rays_of(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (H, W, 3) by the pinhole's definition in float64, and the cosines to the viewing axis."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [(u - camera.middle[0]) / camera.focal[0], (v - camera.middle[1]) / camera.focal[1], np.ones_like(u)], axis=-1
    )
    directions = local @ camera.axes.numpy().T
    length = np.linalg.norm(directions, axis=-1)
    return directions / length[..., None], 1.0 / length, camera.position.numpy()


def sphere_depth(camera: Camera, center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth along the viewing axis and normals of a ball, by the quadratic formula; NaN where it is missed."""
    directions, cosine, origin = rays_of(camera)
    offset = origin - center
    b = directions @ offset
    square = b**2 - offset @ offset + radius**2
    with np.errstate(invalid="ignore"):
        length = -b - np.sqrt(square)
    points = origin + length[..., None] * directions
    return length * cosine, (points - center) / radius


@pytest.mark.parametrize("mode", MODES)
def test_a_ball(mode: str) -> None:
    center = np.array([0.05, 0.0, 0.02])
    field = sphere(0.35, center.tolist())
    options = RenderOptions(mode=mode, inverse_deviation=20_000.0 if mode == "volume" else None)
    frame = render(field, CAMERA, options)
    depth, normal = sphere_depth(CAMERA, center, 0.35)
    hit = np.isfinite(depth)
    seen = frame.depth > 0
    assert hit.sum() > 200
    assert (seen != hit).mean() < 0.01  # the outline's pixels alone
    both = seen & hit
    error, cosine = np.abs(frame.depth - depth), -(normal * rays_of(CAMERA)[0]).sum(-1)
    assert error[both & (cosine > 0.3)].max() < 5e-4
    assert error[both].max() < 5e-3
    assert (frame.normal * normal).sum(-1)[both & (cosine > 0.3)].min() > 0.999
    assert (frame.part[seen] == 0).all()
    assert (frame.part[~seen] == NOTHING).all()
    assert (frame.opacity[~seen] < 0.5).all()


def test_volume_is_the_formula_on_dense_samples() -> None:
    """Opacity and depth of the same rays by the paper's formula: 4000 even samples a ray, float64."""
    field, s = sphere(0.35), 60.0
    camera = CAMERA.resized((24, 18))
    frame = render(field, camera, RenderOptions(mode="volume", inverse_deviation=s))
    directions, cosine, origin = rays_of(camera)
    t = np.linspace(0.2, 2.4, 4000)
    points = origin + directions[..., None, :] * t[:, None]
    inside = (np.abs(points) <= 1.0).all(-1)
    d = np.linalg.norm(points, axis=-1) - 0.35
    phi = 1.0 / (1.0 + np.exp(-s * d))
    alpha = np.clip((phi[..., :-1] - phi[..., 1:]) / phi[..., :-1], 0.0, 1.0) * (inside[..., :-1] & inside[..., 1:])
    passed = np.cumprod(np.concatenate([np.ones_like(alpha[..., :1]), 1.0 - alpha], axis=-1), axis=-1)
    weight = passed[..., :-1] * alpha
    opacity = weight.sum(-1)
    assert np.abs(frame.opacity - opacity).max() < 0.02
    solid = opacity > 0.95
    depth = (weight * (t[:-1] + t[1:]) / 2).sum(-1) / np.maximum(opacity, 1e-9) * cosine
    assert np.abs(frame.depth - depth)[solid].max() < 0.25 / s
    assert np.abs(frame.depth - depth)[solid].mean() < 0.05 / s


def test_thin_sheets_are_not_stepped_over() -> None:
    """A plate of .3 % of the bounds' diagonal before a wall, also seen at a grazing angle."""
    field = boxes([([-0.6, -0.005, -0.6], [0.6, 0.005, 0.6]), ([-0.9, 0.5, -0.9], [0.9, 0.6, 0.9])])
    for place in ([0.1, -0.9, 0.1], [0.85, -0.12, 0.1]):
        frame = render(field, Camera.look_at(place, [0.0, 0.0, 0.0], SIZE, 20.0))
        directions, cosine, origin = rays_of(frame.camera)
        along = (-0.005 - origin[1]) / directions[..., 1]
        met = origin + along[..., None] * directions
        on = (np.abs(met[..., [0, 2]]) < 0.58).all(-1) & (along > 0)
        assert on.sum() > 100
        assert np.abs(frame.depth - along * cosine)[on].max() < 2e-3


def test_tiles_and_antialiasing_change_little() -> None:
    field = sphere(0.35)
    whole = render(field, CAMERA)
    tiled = render(field, CAMERA, RenderOptions(memory_mb=16))
    assert np.array_equal(whole.color, tiled.color)
    fine = render(field, CAMERA, RenderOptions(antialias=3))
    assert np.array_equal(fine.depth, whole.depth)
    assert len(np.unique(fine.opacity)) > 3


@pytest.mark.skipif(not can_fork(), reason="this system cannot copy a process")
@pytest.mark.parametrize("mode", MODES)
def test_processes_change_nothing_that_is_seen(mode: str) -> None:
    field, options = boxes([([-0.3, -0.2, -0.25], [0.25, 0.3, 0.2])]), RenderOptions(mode=mode, memory_mb=16)
    cameras = orbit_cameras(OrbitRequest(frames=2), BOX, (72, 50))
    told: list[float] = []
    for one, two in zip(
        render_frames(field, cameras, options),
        render_frames(field, cameras, options, told.append, processes=2),
        strict=True,
    ):
        assert (np.abs(one.depth - two.depth) > 1e-3).mean() < 0.002
        assert (np.abs(one.color.astype(int) - two.color) > 4).mean() < 0.002
        assert np.array_equal(one.part, two.part)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_progress_and_cancelling() -> None:
    cameras = orbit_cameras(OrbitRequest(frames=3), BOX, (40, 30))
    told: list[float] = []
    frames = list(render_frames(sphere(0.3), cameras, progress=told.append))
    assert len(frames) == 3
    assert told == sorted(told)
    assert told[-1] == 1.0
    answers = iter([False, True])
    with pytest.raises(CancelledError):
        list(render_frames(sphere(0.3), cameras, cancelled=lambda: next(answers)))


def test_a_camera_in_matter() -> None:
    field = sphere(0.35)
    inside = Camera.look_at([0.1, 0.0, 0.0], [1.0, 0.0, 0.0], SIZE)
    with pytest.raises(InvalidInputError) as caught:
        render(field, inside)
    assert caught.value.reason == "CAMERA_INVALID"
    assert (render(field, inside, RenderOptions(cut_away=True)).depth == 0).all()


@pytest.mark.parametrize(
    ("reason", "make"),
    [
        ("RENDER_TOO_LARGE", lambda: Camera.look_at([1, 0, 0], [0, 0, 0], (100_000, 10_000))),
        ("CAMERA_INVALID", lambda: Camera.look_at([1, 0, 0], [1, 0, 0])),
        ("CAMERA_INVALID", lambda: Camera.look_at([math.nan, 0, 0], [1, 0, 0])),
        ("CAMERA_INVALID", lambda: Camera.look_at([1, 0, 0], [0, 0, 0], (64, 48), 180.0)),
        ("CAMERA_INVALID", lambda: Camera.look_at([1, 0, 0], [0, 0, 0], up="w")),
        ("CAMERA_INVALID", lambda: Camera(torch.zeros(3), 2 * torch.eye(3), 4, 4, (4.0, 4.0), (2.0, 2.0))),
        ("CAMERA_INVALID", lambda: Camera.look_at([1, 0, 0], [0, 0, 0], (0, 4))),
        ("COLORS_MISSING", lambda: render(sphere(0.3), CAMERA, RenderOptions(coloring="field"))),
        (
            "NO_SURFACE_IN_SCENE",
            lambda: render(sphere(-5.0), CAMERA),
        ),
        ("FIELD_NOT_FINITE", lambda: render(AnalyticField(lambda p: p[:, 0] * math.nan, [[-1] * 3, [1] * 3]), CAMERA)),
    ],
)
def test_bad_requests_have_reasons(reason: str, make: Callable[[], object]) -> None:
    with pytest.raises(RegnfError) as caught:
        make()
    assert caught.value.reason == reason


def test_an_orbit_sees_its_box() -> None:
    box = OrientedBox.from_corners([0.1, 0.2, 0.3], [0.5, 0.4, 0.9])
    for camera in orbit_cameras(OrbitRequest(frames=5, elevation_deg=-20.0, start_deg=10.0), box, (64, 48)):
        local = (box.corners() - camera.position) @ camera.axes
        places = local[:, :2] / local[:, 2:] * torch.tensor(camera.focal) + torch.tensor(camera.middle)
        assert (local[:, 2] > 0).all()
        assert ((places > 0) & (places < torch.tensor([64, 48]))).all()
        assert torch.allclose(camera.axes[2, 1].sign(), torch.tensor(-1.0, dtype=torch.float64))  # upright


# Bundles of rays: nothing is passed over, and few evaluations are spent. Truth: dense samples of exact distances.


BEAMS = (64, 48)
ROD = ([0.11, -0.4, 0.0], [0.122, 0.4, 0.012])
"""Thinner than a pixel of the bundles, and than a cell of the grid."""
FIELDS = {
    "ball": sphere(0.35, [0.05, 0.0, 0.02]),
    "rod before a slab": boxes([ROD, ([-0.7, -0.9, -0.9], [-0.2, 0.9, 0.9])]),
}
CAMERAS = {
    "within": Camera.look_at([0.45, -0.1, 0.1], [-0.2, 0.0, 0.0], BEAMS, 60.0),
    "outside": Camera.look_at([1.9, -0.7, 0.6], [0.0, 0.0, 0.0], BEAMS, 40.0),
}


def begun(field: SdfField, camera: Camera, margin: float = 0.0) -> tuple[Region, Rays, Start]:
    pixels = torch.arange(BEAMS[0] * BEAMS[1])
    rays, _ = camera.rays(pixels)
    region = Region.along(rays, field, DistanceGrid.of(field), 4e-4)
    return region, rays, free_start(region, rays, pixels // BEAMS[0], pixels % BEAMS[0], margin)


def sampled(field: SdfField, region: Region, rays: Rays, lengths: Tensor) -> Tensor:
    """(N, K) distances between each ray's entry and its length (N,)."""
    share = torch.linspace(0.0, 1.0, 400)
    t = region.entry[:, None] + share * (lengths - region.entry)[:, None]
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    return field.signed_distance(points.view(-1, 3)).view(len(lengths), -1)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS.keys())
def test_no_ray_is_moved_past_a_surface(field: AnalyticField, camera: Camera) -> None:
    region, rays, start = begun(field, camera)
    ahead = start.free & (region.exit > region.entry)
    assert bool(ahead.any())
    passed = sampled(field, region, rays, torch.minimum(start.length, region.exit))[ahead]
    assert float(passed.min()) > 0.0
    assert bool((start.length >= region.entry).all())


def test_a_margin_is_kept() -> None:
    field, margin = FIELDS["ball"], 0.01
    _, rays, start = begun(field, CAMERAS["within"], margin)
    ends = rays.origins + start.length[:, None] * rays.directions
    assert float(field.signed_distance(ends[start.free]).min()) > margin


def test_a_pixel_takes_few_evaluations() -> None:
    field = CountingField(sphere(0.35, [0.05, 0.0, 0.02]))
    DistanceGrid.of(field)
    prepared = field.evaluations
    render(field, CAMERAS["within"], RenderOptions())
    asked = field.evaluations - 2 * prepared
    assert asked / (BEAMS[0] * BEAMS[1]) < 6.0
