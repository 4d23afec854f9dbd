"""What cameras observed of a field that was made from their images: told by where they stood, without the images.

A ray of sight ends at the field's first surface. What lies before is free, a surface to which one leads was observed,
and what lies behind was not. Surface that a field has invented is behind what was observed, or it would be in the way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import Observation, SdfField
from regnf_core.geometry.pinhole import PinholeCameras
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_core.surface.result_clouds import project_to_surface
from regnf_core.surface.sphere_tracing import Rays, clip_to_region, finite_distance, free_lengths, shortest_step
from regnf_core.surface.surface_cells import Cells, surface_cells

# Coarse depth images of a field, as cameras at given places would have taken them: by sphere tracing.


@dataclass(frozen=True, eq=False)
class TracedDepths:
    """One image. free: (H, W) float32, depths along the camera's axis up to which its rays are free, 0 where nothing is
    known · meets: (H, W) bool, whether a surface ends them there."""

    free: Tensor
    meets: Tensor

    def places(self) -> Tensor:
        """(H, W, 2) float64, the image coordinates of its rays."""
        return _places(*self.free.shape)

    def around(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """The least and the largest depth (M,), (M,) of the four rays round image coordinates (M, 2)."""
        height, width = self.free.shape
        size = torch.tensor([width, height], dtype=places.dtype)
        first = (places * size - 0.5).floor().long()
        column, row = first.unbind(-1)
        columns = [column.clamp(0, width - 1), (column + 1).clamp(0, width - 1)]
        rows = [row.clamp(0, height - 1), (row + 1).clamp(0, height - 1)]
        depths = torch.stack([self.free.view(-1)[y * width + x] for x in columns for y in rows])
        return depths.amin(0), depths.amax(0)


def trace_depths(field: SdfField, cameras: PinholeCameras, rays_each: int) -> list[TracedDepths]:
    """An image a camera, of about ``rays_each`` rays, evenly spread over it. The region is the field's bounds."""
    images = []
    for camera in range(len(cameras)):
        width = max(2, round(math.sqrt(rays_each * float(cameras.aspect[camera]))))
        height = max(2, round(rays_each / width))
        places = _places(height, width).view(-1, 2)
        free, meets = free_depths(field, cameras.positions[camera], cameras.directions(camera, places))
        images.append(TracedDepths(free.view(height, width), meets.view(height, width)))
    return images


def _places(height: int, width: int) -> Tensor:
    rows = (torch.arange(height, dtype=torch.float64) + 0.5) / height
    columns = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    return torch.stack([columns.expand(height, width), rows[:, None].expand(height, width)], -1)


def free_depths(field: SdfField, position: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """How often its direction (M, 3) each ray from ``position`` is free, (M,), and whether it ends at a surface."""
    lengths = directions.norm(dim=-1)
    rays = Rays(position.expand_as(directions).float(), (directions / lengths[:, None]).float())
    low, high = field.bounds
    entry, exit_ = clip_to_region(rays, low, high)
    free, meets = free_lengths(field, rays, entry, exit_, shortest_step(float((high - low).norm())))
    return free / lengths.float(), meets


_BASE = 40
"""Voxels along the longest side of the observed region, before they are halved."""
_POINTS_A_RAY = 12
_RAYS_SHARE = 0.4
"""Of all evaluations, those for the images' rays. The surface's voxels take about as many, and the rest is for single
points."""
_POINTS_HALVED = (400_000, 2_500_000)
"""With so many evaluations and more the voxels are halved, once and twice."""
_MOST_CAMERAS, _RAYS_EACH = 128, 400
"""Cameras that are used at most; rays of each at least, where there are so many."""
_MARGIN = 1.0
"""Voxels before a surface that may be matter as well."""
_CLOSE = 0.5
"""Voxels behind the least depth of the rays around it at which a point is seen all the same."""
_TRIES = 4
"""Cameras that a single point is looked for from."""
_SEEING = 0.02
"""A camera sees the field where so large a share of its rays ends at a surface; half of the cameras have to."""
_SLOPE = 0.2
_SUSPECT = 0.8
"""Of all rays, that end at a surface: where more do, no other convention is tried."""
_DOUBTFUL = 3.0
"""Odds that a ray ends at a surface, by another convention over those by the stated one, with which one warns. Right
cameras have such odds as well, where they look out of a field's open side: so nobody is refused for them."""
_ALIKE = 0.03
"""Shares of rays that say nothing of which cameras are better; the first of such are taken."""


def observe_by_cameras(
    field: SdfField, cameras: PinholeCameras, points: int, others: Sequence[tuple[str, PinholeCameras]] = ()
) -> tuple[Observation, str | None]:
    """What the cameras, in the field's frame, observed within its bounds; and a warning where they may be others.

    points: evaluations of the field, about; fewer make voxels larger, and images coarser · others: the same cameras by
    other conventions, each with what it is and what to do about it, the usual ones first. Deterministic.
    Raises FieldFormatError (CAMERAS_OF_ANOTHER_FRAME) where most of them see nothing of the field.
    """
    rays = int(_RAYS_SHARE * points / _POINTS_A_RAY)
    chosen = cameras.evenly(max(1, min(_MOST_CAMERAS, rays // _RAYS_EACH)))
    images = trace_depths(field, chosen, max(4, rays // len(chosen)))
    doubt = _checked_sight(others, field, images, rays)
    ends = _ends(chosen, images)
    grid = _grid_round(ends, field.bounds, sum(points >= enough for enough in _POINTS_HALVED))
    states = torch.full(grid.counts, UNSEEN, dtype=torch.uint8).view(-1)
    base = max(grid.counts) >> grid.halvings
    cells, _ = surface_cells(partial(_distance, field), grid.low, grid.high, base, grid.halvings)
    states[_looked_through(grid.middles(), chosen, images, _MARGIN * grid.voxel)] = FREE
    near = grid.index(cells.centers)
    states[near[cells.values < 0]] = UNSEEN
    states[near[_seen_surface(field, cells, chosen, images)]] = SURFACE
    states[grid.index(ends)] = SURFACE
    return Observation(states.view(grid.counts), grid.low, grid.voxel), doubt


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where the voxels are: their lowest corner (3,), counts and edge; they are halves of halves of larger ones."""

    low: Tensor
    counts: list[int]
    voxel: float
    halvings: int

    @property
    def high(self) -> Tensor:
        """The highest corner (3,)."""
        return self.low + torch.tensor(self.counts) * self.voxel

    def middles(self) -> Tensor:
        """Of all voxels, (N, 3) float32."""
        axes = [self.low[k] + (torch.arange(self.counts[k], dtype=torch.float64) + 0.5) * self.voxel for k in range(3)]
        return torch.cartesian_prod(*axes).float()

    def index(self, points: Tensor) -> Tensor:
        """The numbers of the voxels of points (M, 3), which lie within the grid but for rounding."""
        cell = ((points - self.low) / self.voxel).floor().long()
        x, y, z = torch.minimum(cell.clamp_min(0), torch.tensor(self.counts) - 1).unbind(-1)
        return (x * self.counts[1] + y) * self.counts[2] + z


def _grid_round(ends: Tensor, bounds: Tensor, halvings: int) -> _Grid:
    """Voxels round all points (M, 3) at which rays end, within the bounds (2, 3)."""
    low, high = ends.amin(0), ends.amax(0)
    edge = float((high - low).max()) / (_BASE - 2)
    low, high = torch.maximum(low - edge, bounds[0]), torch.minimum(high + edge, bounds[1])
    counts = ((high - low) / edge - 1e-9).ceil().clamp_min(1)
    low = (low + high) / 2 - counts * edge / 2
    return _Grid(low, [int(count) << halvings for count in counts], edge / 2**halvings, halvings)


def _ends(cameras: PinholeCameras, images: list[TracedDepths]) -> Tensor:
    """(M, 3) float64 where rays end at a surface."""
    found = []
    for camera, image in enumerate(images):
        if _share_meeting([image]) >= _SEEING:
            depths = image.free[image.meets].double()[:, None]
            found.append(cameras.positions[camera] + depths * cameras.directions(camera, image.places()[image.meets]))
    return torch.cat(found)


def _checked_sight(
    others: Sequence[tuple[str, PinholeCameras]], field: SdfField, images: list[TracedDepths], rays: int
) -> str | None:
    """A warning where others see far more. Raises FieldFormatError (CAMERAS_OF_ANOTHER_FRAME) where most cameras see
    nothing.

    The field was made of what its cameras saw. So they stood in free space, and before them is a surface. Others may
    see one as well, in a closed room; those that are right see one with nearly all of their rays.
    """
    own = _share_meeting(images)
    if own >= _SUSPECT:
        return None
    best, told = own, ""
    for name, cameras in others:
        tried = cameras.evenly(_MOST_CAMERAS // len(others))
        share = _share_meeting(trace_depths(field, tried, max(4, rays // (len(others) * len(tried)))))
        if share > best + _ALIKE:
            best, told = share, name
    seeing = sum(_share_meeting([image]) >= _SEEING for image in images)
    odds, sees = _odds(best, len(images)) / _odds(own, len(images)), 2 * seeing >= len(images)
    if sees and odds < _DOUBTFUL:
        return None
    more = f"{100 * own:.2g} % of the lines of sight end at a surface of the field; {100 * best:.2g} % with {told}"
    if sees:
        return f"CAMERAS_DOUBTFUL: {more}"
    message = f"{len(images) - seeing} of {len(images)} cameras are inside solid matter, or see no surface of the field"
    message += f"; {more}" if told else ". Check that cameras and field are of the same scene, in the same frame"
    raise FieldFormatError(message, reason="CAMERAS_OF_ANOTHER_FRAME")


def _odds(share: float, cameras: int) -> float:
    """That a ray ends at a surface, by the share of the rays of so many cameras: the fewer, the nearer to 1.

    Rays of one camera are much alike. So they count as one.
    """
    return (cameras * share + 0.5) / (cameras * (1.0 - share) + 0.5)


def _share_meeting(images: list[TracedDepths]) -> float:
    """Of all rays, from 0 to 1."""
    return float(torch.stack([image.meets.float().mean() for image in images]).mean())


def _looked_through(points: Tensor, cameras: PinholeCameras, images: list[TracedDepths], margin: float) -> Tensor:
    """(N,) bool: which points (N, 3) a camera looked through, before all of the rays around them by ``margin``."""
    through = torch.zeros(len(points), dtype=torch.bool)
    left = torch.arange(len(points))
    for camera, image in enumerate(images):
        places, depth = cameras.project(camera, points[left])
        at = _shown(places, depth).nonzero()[:, 0]
        at = at[depth[at] < image.around(places[at])[0] - margin]
        through[left[at]] = True
        left = left[~through[left]]
    return through


def _seen_surface(field: SdfField, cells: Cells, cameras: PinholeCameras, images: list[TracedDepths]) -> Tensor:
    """(N,) bool: which cells hold surface that a line of sight leads to."""
    points = project_to_surface(field.signed_distance_and_gradient, cells.centers.float(), 1, _SLOPE).points
    seen = torch.zeros(len(points), dtype=torch.bool)
    tries = torch.zeros(len(points), dtype=torch.uint8)
    left = torch.arange(len(points))
    doubtful: list[tuple[int, Tensor]] = []
    for camera, image in enumerate(images):
        places, depth = cameras.project(camera, points[left])
        at = _shown(places, depth).nonzero()[:, 0]
        least, largest = image.around(places[at])
        before = depth[at] - _CLOSE * cells.edge
        seen[left[at[before <= least]]] = True
        doubtful.append((camera, left[at[(before > least) & (before <= largest)]]))
        left = left[~seen[left]]
    for camera, asked in doubtful:
        asked = asked[~seen[asked] & (tries[asked] < _TRIES)]
        tries[asked] += 1
        seen[asked] = _sees(field, cameras.positions[camera], points[asked], _CLOSE * cells.edge)
    return seen


def _sees(field: SdfField, position: Tensor, points: Tensor, close: float) -> Tensor:
    """(M,) bool: to which points (M, 3) the straight line from ``position`` is free, but for the last ``close``."""
    directions = points.double() - position
    if len(directions) == 0:
        return torch.zeros(0, dtype=torch.bool)
    free, _ = free_depths(field, position, directions)
    sees: Tensor = free >= 1.0 - close / directions.norm(dim=-1)
    return sees


def _shown(places: Tensor, depth: Tensor) -> Tensor:
    """(M,) bool: which image coordinates (M, 2) lie in the image, before the camera."""
    shown: Tensor = (depth > 0.0) & (places >= 0.0).all(-1) & (places < 1.0).all(-1)
    return shown


def _distance(field: SdfField, points: Tensor) -> Tensor:
    return finite_distance(field, points.float())
