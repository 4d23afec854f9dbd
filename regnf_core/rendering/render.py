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
from regnf_core.fields.base import SdfField
from regnf_core.fields.transformed import near_origin
from regnf_core.processes import can_fork, in_processes
from regnf_core.rendering.beams import free_start
from regnf_core.rendering.camera import Camera
from regnf_core.rendering.distance_grid import DistanceGrid
from regnf_core.rendering.frame import NOTHING, Frame
from regnf_core.rendering.options import RenderOptions, check_extent
from regnf_core.rendering.samples import TileSamples
from regnf_core.rendering.shading import Painter
from regnf_core.rendering.surface_mode import surface_samples
from regnf_core.rendering.tracing import Region
from regnf_core.rendering.volume_mode import CLEAR, volume_samples
from regnf_core.surface.cameras import Rays
from regnf_core.surface.sphere_tracing import finite_distance

Part = NDArray[Any]
"""(P, ...): one thing that is known of the pixels of a tile."""
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
    Raises InvalidInputError: CAMERA_IN_MATTER, RENDER_TOO_LARGE, FIELD_NOT_FINITE, COLORS_MISSING; NoSurfaceError
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
            raise CancelledError("the rendering was cancelled")

    done = _watched(_done(work, tasks, processes, check), len(tasks), check, progress)
    for camera, of_frame in zip(cameras, tiles, strict=True):
        yield _frame(camera, of_frame, done)


def _done(
    work: Callable[[tuple[int, int]], list[Part]],
    tasks: Sequence[tuple[int, int]],
    processes: int,
    check: Callable[[], None],
) -> Iterator[list[Part]]:
    return in_processes(work, tasks, processes, check) if processes > 1 else map(work, tasks)


def _watched(
    tiles: Iterator[list[Part]], count: int, check: Callable[[], None], progress: Progress | None
) -> Iterator[list[Part]]:
    """The same, with ``check`` before each, and ``progress`` told once it is there."""
    for number in range(1, count + 1):
        check()
        tile = next(tiles)
        if progress is not None:
            progress(number / count)
        yield tile


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
        up = torch.zeros(3)
        up["xyz".index(options.up[-1])] = -1.0 if options.up.startswith("-") else 1.0
        painter = Painter.of(field, up, options)
        grid = DistanceGrid.of(field)
        if bool((grid.bound > 0).all()):
            raise NoSurfaceError("the field has no surface within its bounds", reason="NO_SURFACE_IN_SCENE")
        return cls(field, grid, painter, options)

    def check(self, camera: Camera, position: Tensor) -> None:
        """Raises InvalidInputError (CAMERA_IN_MATTER): the camera stands within the bounds and in matter.

        position: where it is, as its user says it.
        """
        low, high = self.field.bounds
        within = bool(((camera.position >= low) & (camera.position <= high)).all())
        if not within or self.options.cut_away:
            return
        if float(finite_distance(self.field, camera.position[None].float().to(self.field.device))[0]) <= 0.0:
            place = ", ".join(f"{value:.4g}" for value in position.tolist())
            hint = "Move it into free space, or let what is before it be cut away: option cut_away."
            raise InvalidInputError(f"the camera at ({place}) is in matter", reason="CAMERA_IN_MATTER", hint=hint)

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
        samples = self._samples(rays, pixels // camera.width, pixels % camera.width)
        colors, parts = self.painter.colors(samples, rays.directions[samples.ray])
        blank = torch.zeros_like(rays.origins)
        color = blank.index_add(0, samples.ray, samples.weight[:, None] * colors)
        background = torch.tensor(self.options.background, device=color.device)
        color = color + (1.0 - samples.opacity)[:, None] * background
        normal = blank.index_add(0, samples.ray, samples.weight[:, None] * samples.normals)
        seen = (samples.opacity >= _LEAST_SEEN).cpu()
        depth = torch.where(seen, samples.length.cpu() * cosine, 0.0)
        part = torch.where(seen, _main_part(samples, parts, len(pixels), len(self.painter.parts)).cpu(), NOTHING)
        return color.cpu(), normal.cpu(), samples.opacity.cpu(), depth, part.to(torch.int16)

    def _samples(self, rays: Rays, rows: Tensor, columns: Tensor) -> TileSamples:
        rows, columns = rows.to(rays.origins.device), columns.to(rays.origins.device)
        region = Region.along(rays, self.field, self.grid, _TOLERANCE)
        if self.options.mode == "surface":
            return surface_samples(region, rays, free_start(region, rays, rows, columns))
        least = self.painter.least_sharpness
        start = free_start(region, rays, rows, columns, 2.0 * CLEAR / least)
        return volume_samples(region, rays, start, self.painter.distance_and_sharpness, least)


def _main_part(samples: TileSamples, parts: Tensor, rays: int, count: int) -> Tensor:
    """(N,): the part that gives most of a ray's color."""
    shares = samples.weight.new_zeros(rays * count)
    shares.index_add_(0, samples.ray * count + parts, samples.weight)
    return shares.view(rays, count).argmax(dim=-1)


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
