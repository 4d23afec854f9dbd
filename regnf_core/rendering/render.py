"""Frames of a field."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.errors import CancelledError, InvalidInputError, NoSurfaceError
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import SdfField
from regnf_core.processes import can_fork, in_processes
from regnf_core.rendering.camera import NOTHING, Camera, Frame
from regnf_core.rendering.request import RenderOptions, check_extent
from regnf_core.rendering.tracing import PLAIN_SHARE, DistanceGrid, Region, Start, trace
from regnf_core.rendering.volume_mode import CLEAR, Painter, TileSamples, volume_samples
from regnf_core.surface.sphere_tracing import Rays, finite_distance

# How far whole bundles of neighboring rays are free: one evaluation of the field for many rays.
#
# A ball of radius D around the point at length t of a bundle's middle ray is free of surfaces. All its rays have the
# same origin, and at length t none is farther from the middle one than t times the largest chord between their unit
# directions. So all of them are free up to the length t + D - t chord. Where that is no more worth a step, the bundle
# is divided into four. (Cone marching: Bastos and Celes 2012 for height fields; Hart 1996 for the balls.)

_EDGES = (16, 8, 4, 2)
"""Pixels along the sides of a bundle."""
_WORTH = 0.5
"""Least step, as a share of the bundle's half width: shorter ones are left to smaller bundles."""
_MOST_STEPS = 128
_FEW = 16
"""As soon as no more than one bundle of so many goes on, the others' parts are gone on with: a call of the field for
a few points takes as long as for many."""
_LEAPS = 2.0
"""Length, in shortest steps, by which a bundle is moved on at once where it leaves matter."""


@dataclass(frozen=True)
class _Bundles:
    """G bundles of rays with one origin.

    of: (N,), each ray's bundle · origin: (3,) · direction: (G, 3) unit, the middle · chord: (G,), the largest from the
    middle's direction to a ray's.
    """

    of: Tensor
    origin: Tensor
    direction: Tensor
    chord: Tensor

    @classmethod
    def over(cls, rays: Rays, rows: Tensor, columns: Tensor, edge: int) -> _Bundles:
        """Squares of ``edge`` pixels. rows, columns: (N,) int64, of each ray's pixel."""
        wide = int(columns.max()) // edge + 1
        _, of = torch.unique((rows // edge) * wide + columns // edge, return_inverse=True)
        count = int(of.max()) + 1
        total = rays.directions.new_zeros(count, 3).index_add_(0, of, rays.directions)
        direction = torch.nn.functional.normalize(total, dim=-1)
        chord = (rays.directions - direction[of]).norm(dim=-1)
        return cls(of, rays.origins[0], direction, _reduced(chord, of, count, "amax"))

    def points(self, index: Tensor, t: Tensor) -> Tensor:
        """(M, 3) at lengths t (M,) of the middles of the bundles ``index`` (M,)."""
        return self.origin + t[:, None] * self.direction[index]


def free_start(region: Region, rays: Rays, rows: Tensor, columns: Tensor, margin: float = 0.0) -> Start:
    """Lengths along rays of one origin up to which they are free, or in matter where they begin in matter.

    rows, columns: (N,) int64, of each ray's pixel · margin: distance that is kept to a surface.
    """
    length, free = region.entry.clone(), torch.zeros_like(region.entry, dtype=torch.bool)
    live = (region.exit > region.entry).nonzero().squeeze(-1)
    for edge in _EDGES:
        if live.numel() == 0:
            break
        part = Rays(rays.origins[live], rays.directions[live])
        bundles = _Bundles.over(part, rows[live], columns[live], edge)
        length[live], free[live] = _follow(region, bundles, length[live], region.exit[live], free[live], margin)
        live = live[length[live] < region.exit[live]]
    return Start(length, free)


def _follow(
    region: Region, bundles: _Bundles, begin: Tensor, end: Tensor, free: Tensor, margin: float
) -> tuple[Tensor, Tensor]:
    """Where each ray (N,) stands once its bundle can go no farther, and whether it is free there."""
    count = len(bundles.chord)
    far, near = (_reduced(begin, bundles.of, count, how) for how in ("amax", "amin"))
    last = _reduced(end, bundles.of, count, "amax")
    some_free = _reduced(free.to(begin), bundles.of, count, "amax") > 0
    reached, is_free, moved = far.clone(), some_free.clone(), torch.zeros_like(some_free)
    leapt = torch.zeros_like(some_free)
    index = torch.arange(count, device=begin.device)
    t, behind = far.clone(), far - near  # a ball has to reach back to the ray that is farthest behind
    for _ in range(_MOST_STEPS):
        if index.numel() * _FEW <= count:
            break
        width = t * bundles.chord[index]
        distance = region.clamped_distance(bundles.points(index, t))
        step = PLAIN_SHARE * distance.abs() - width - margin
        out = distance > 0
        goes = (step > behind) & (step > _WORTH * width) & (step > region.shortest) & (out | ~is_free[index])
        at = index[goes]
        reached[at], moved[at] = (t + step)[goes], True
        is_free[at] |= out[goes]
        leaps = ~goes & ~is_free[index] & ~leapt[index] & moved[index]
        leapt[index[leaps]] = True
        t = torch.where(goes, t + step, t + _LEAPS * region.shortest)
        on = (goes | leaps) & (t < last[index])
        index, t = index[on], t[on]
        behind = torch.zeros_like(t)
    advanced = moved[bundles.of]
    length = torch.where(advanced, torch.maximum(begin, reached[bundles.of]), begin)
    return length, torch.where(advanced, is_free[bundles.of], free)


def _reduced(values: Tensor, of: Tensor, count: int, how: str) -> Tensor:
    """(count,): the largest or least of the values (N,) of each bundle."""
    return values.new_zeros(count).scatter_reduce_(0, of, values, how, include_self=False)


# Surface rendering: a ray sees the point where it first meets the zero level, and that is opaque.

_LONGEST_CORRECTION = 5.0
"""Of a hit along its ray by the gradient, in tolerances."""
_FLATTEST = 0.05
"""Least cosine between ray and surface at which the gradient is used for that."""


def surface_samples(region: Region, rays: Rays, start: Start) -> TileSamples:
    """One sample a ray that meets a surface, with its normal; a last Newton step along the ray makes it exact."""
    length = trace(region, rays, start)
    ray = torch.isfinite(length).nonzero().squeeze(-1)
    points = rays.origins[ray] + length[ray, None] * rays.directions[ray]
    distance, gradient = (value.to(points) for value in region.field.signed_distance_and_gradient(points))
    slope = (gradient * rays.directions[ray]).sum(-1)
    correction = torch.where(slope < -_FLATTEST, -distance / slope.clamp_max(-_FLATTEST), 0.0)
    most = _LONGEST_CORRECTION * region.tolerance
    correction = correction.clamp(-most, most)
    points = points + correction[:, None] * rays.directions[ray]
    length = torch.where(torch.isfinite(length), length, 0.0)
    length[ray] += correction
    opacity = torch.zeros_like(length)
    opacity[ray] = 1.0
    normals = torch.nn.functional.normalize(gradient, dim=-1)
    return TileSamples(ray, points, normals, torch.ones_like(correction), opacity, length)


Part = NDArray[Any]
"""(P, ...): one object that is known of the pixels of a tile."""
Progress = Callable[[float], None]
"""Called with the share done, 0..1, after each tile. May raise CancelledError to stop the work."""

_BYTES_A_RAY = {"surface": 1500, "volume": 4000}
_MOST_RAYS = {"cpu": 1 << 16}
"""In a tile, so that progress and cancelling are heard of; other devices need more rays to be busy."""
_MOST_RAYS_ELSEWHERE = 1 << 19
_TILES_A_PROCESS = 2
"""Of each frame, at least: processes that have done theirs help the others."""
_TILE_STEP = 16
"""Pixels along a tile's side are a multiple of it: bundles of rays are not cut."""
_TOLERANCE = 4e-4
"""Of the bounds' diagonal: distance at which a ray has reached a surface. A step of Newton's method follows."""
_LEAST_SEEN = 0.5
"""Opacity from which on a pixel has a depth and a part."""


def render(
    field: SdfField,
    camera: Camera,
    options: RenderOptions | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Frame:
    """One frame. See ``render_frames``."""
    return next(render_frames(field, [camera], options, progress, cancelled))


def render_frames(
    field: SdfField,
    cameras: Sequence[Camera],
    options: RenderOptions | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    processes: int = 1,
) -> Iterator[Frame]:
    """A frame a camera, one after the other, on the field's device. What rays share is prepared once.

    ``cancelled`` is asked before each tile; CancelledError is raised once it says so. processes: forked copies of this
    process that share the tiles, where the system can and the field is on the CPU; the frames are the same.
    Raises InvalidInputError: CAMERA_INVALID, RENDER_TOO_LARGE, FIELD_NOT_FINITE, COLORS_MISSING; NoSurfaceError
    (NO_SURFACE_IN_SCENE); ProcessLostError (WORKER_LOST).
    """
    chosen = options or RenderOptions()
    check_extent(len(cameras), max((camera.width * camera.height for camera in cameras), default=0))
    field, origin = near_origin(field)  # rays are float32
    near = [replace(camera, position=camera.position - origin) for camera in cameras]
    renderer = Renderer.of(field, chosen)
    for camera, moved in zip(cameras, near, strict=True):  # before the work, which would be lost
        renderer.check(moved, camera.position)
    if field.device.type != "cpu" or not can_fork():
        processes = 1
    tiles = [renderer.tiles(camera, processes) for camera in near]
    tasks = [(number, tile) for number, of_frame in enumerate(tiles) for tile in range(len(of_frame))]

    def work(task: tuple[int, int]) -> list[Part]:
        number, tile = task
        return [part.numpy() for part in renderer.tile(near[number], tiles[number][tile])]

    def check() -> None:
        if cancelled is not None and cancelled():
            raise CancelledError("the rendering was canceled")

    def watched() -> Iterator[list[Part]]:
        done = in_processes(work, tasks, processes, check) if processes > 1 else map(work, tasks)
        for number in range(1, len(tasks) + 1):
            check()
            tile = next(done)
            if progress is not None:
                progress(number / len(tasks))
            yield tile

    done = watched()
    for camera, of_frame in zip(cameras, tiles, strict=True):
        yield _frame(camera, of_frame, done)


@dataclass(frozen=True, eq=False)
class Renderer:
    """A field, ready to be looked at: with the grid of its empty cells, and what colors it."""

    field: SdfField
    grid: DistanceGrid
    painter: Painter
    options: RenderOptions

    @classmethod
    def of(cls, field: SdfField, options: RenderOptions) -> Renderer:
        """Raises InvalidInputError (FIELD_NOT_FINITE, COLORS_MISSING) and NoSurfaceError (NO_SURFACE_IN_SCENE)."""
        painter = Painter.of(field, options)
        grid = DistanceGrid.of(field)
        if bool((grid.bound > 0).all()):
            raise NoSurfaceError("the field has no surface within its bounds", reason="NO_SURFACE_IN_SCENE")
        return cls(field, grid, painter, options)

    def check(self, camera: Camera, position: Tensor) -> None:
        """Raises InvalidInputError (CAMERA_INVALID): the camera stands within the bounds and in matter.

        position: where it is, as its user says it.
        """
        low, high = self.field.bounds
        within = bool(((camera.position >= low) & (camera.position <= high)).all())
        if not within or self.options.cut_away:
            return
        if float(finite_distance(self.field, camera.position[None].float().to(self.field.device))[0]) <= 0.0:
            place = ", ".join(f"{value:.4g}" for value in position.tolist())
            hint = (
                "Move the camera into free space, or set the option cut_away, which removes the matter in front of it."
            )
            raise InvalidInputError(
                f"the camera at ({place}) is inside solid matter", reason="CAMERA_INVALID", hint=hint
            )

    def tiles(self, camera: Camera, processes: int) -> list[Tensor]:
        """The pixels of the frame in rectangles that fit the memory, and are enough for the processes."""
        most = max(256, self.options.memory_mb * 1_000_000 // processes // _BYTES_A_RAY[self.options.mode])
        most = min(most, _MOST_RAYS.get(self.field.device.type, _MOST_RAYS_ELSEWHERE))
        if processes > 1:
            most = min(most, -(-camera.width * camera.height // (_TILES_A_PROCESS * processes)))
        wide = min(camera.width, max(_TILE_STEP, most // _TILE_STEP // _TILE_STEP * _TILE_STEP))
        high = max(_TILE_STEP, most // wide // _TILE_STEP * _TILE_STEP)
        pixels = torch.arange(camera.width * camera.height).view(camera.height, camera.width)
        return [tile.flatten() for row in torch.split(pixels, high) for tile in torch.split(row, wide, dim=1)]

    @torch.no_grad()
    def tile(self, camera: Camera, pixels: Tensor) -> tuple[Tensor, ...]:
        """What is seen in pixels (P,), means over their parts: as ``_rays_through``; depth and part of the middle."""
        fine = self.options.antialias
        places = [((place % fine + 0.5) / fine, (place // fine + 0.5) / fine) for place in range(fine * fine)]
        seen = [self._rays_through(camera, pixels, at) for at in places]
        color, normal, opacity = (sum(parts) / fine**2 for parts in list(zip(*seen, strict=True))[:3])
        _, _, _, depth, part = seen[(fine // 2) * (fine + 1)]
        return color, normal, opacity, depth, part

    def _rays_through(self, camera: Camera, pixels: Tensor, at: tuple[float, float]) -> tuple[Tensor, ...]:
        """color (P, 3), normal (P, 3), opacity (P,), depth (P,), part (P,) of pixels (P,), on the CPU."""
        rays, cosine = camera.rays(pixels, at)
        rays = Rays(rays.origins.to(self.field.device), rays.directions.to(self.field.device))
        rows, columns = (at.to(rays.origins.device) for at in (pixels // camera.width, pixels % camera.width))
        region = Region.along(rays, self.field, self.grid, _TOLERANCE)
        if self.options.mode == "surface":
            samples = surface_samples(region, rays, free_start(region, rays, rows, columns))
        else:
            least = self.painter.least_sharpness
            start = free_start(region, rays, rows, columns, 2.0 * CLEAR / least)
            samples = volume_samples(region, rays, start, self.painter.distance_and_sharpness, least)
        colors, parts = self.painter.colors(samples.points, rays.directions[samples.ray], samples.normals)
        blank = torch.zeros_like(rays.origins)
        color = blank.index_add(0, samples.ray, samples.weight[:, None] * colors)
        background = torch.tensor(self.options.background, device=color.device)
        color = color + (1.0 - samples.opacity)[:, None] * background
        normal = blank.index_add(0, samples.ray, samples.weight[:, None] * samples.normals)
        seen = (samples.opacity >= _LEAST_SEEN).cpu()
        depth = torch.where(seen, samples.length.cpu() * cosine, 0.0)
        count = len(self.painter.parts)
        shares = samples.weight.new_zeros(len(pixels) * count)
        shares.index_add_(0, samples.ray * count + parts, samples.weight)
        # the part that gives most of a ray's color
        part = torch.where(seen, shares.view(len(pixels), count).argmax(dim=-1).cpu(), NOTHING)
        return color.cpu(), normal.cpu(), samples.opacity.cpu(), depth, part.to(torch.int16)


def _frame(camera: Camera, tiles: Sequence[Tensor], done: Iterator[list[Part]]) -> Frame:
    pixels = camera.width * camera.height
    color, normal = np.zeros((pixels, 3), np.float32), np.zeros((pixels, 3), np.float32)
    opacity, depth = np.zeros(pixels, np.float32), np.zeros(pixels, np.float32)
    part = np.full(pixels, NOTHING, np.int16)
    for tile in tiles:
        at = tile.numpy()
        color[at], normal[at], opacity[at], depth[at], part[at] = next(done)
    shape = camera.height, camera.width
    return Frame(
        camera,
        depth.reshape(shape),
        normalize(torch.from_numpy(normal), dim=-1).view(*shape, 3).numpy(),
        (color.clip(0.0, 1.0) * 255.0).round().astype(np.uint8).reshape(*shape, 3),
        np.minimum(opacity, 1.0).reshape(shape),
        part.reshape(shape),
    )
