"""Multi-view surface sampling (paper, section III-C.1): points on the scene's and the object's surface.

Cameras look at the object from several sides; every ray returns the first point where the field is zero.
"""

from __future__ import annotations

from itertools import islice

import torch
from torch import Tensor

from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import Axis, SamplingOptions
from regnf_core.surface.requirements import require_box_in_scene, require_surface
from regnf_core.surface.sphere_tracing import (
    Rays,
    axis_vector,
    camera_positions,
    cast_rays,
    clip_to_region,
    first_hits,
    points_in_order,
    shortest_step,
    surface_bounds,
)

_BOX_MARGIN = 0.05  # the box is grown by this share of its size before points outside are dropped
_TOLERANCE_SHARE = 1e-3  # of the box's diagonal: largest |S| at a returned point
_CLEARANCE = 0.75  # a camera keeps this many box diagonals from the center at least: outside the box, with room to see

_PARTS_OF_A_GROUP = 16
"""Four million rays, at about 100 bytes each while they are followed."""


def sample_scene(
    scene: SdfField, detection: OrientedBox, options: SamplingOptions, turn: float = 0.0, up_axis: Axis = "z"
) -> SurfaceSamples:
    """Points of the scene's surface within the detection box, ground removed. Scene frame, scene units.

    ``turn`` (radians) rotates the cameras about the vertical, for an independent set of views.
    Raises InvalidDetectionError (DETECTION_OUTSIDE_SCENE), NoSurfaceError (NO_SURFACE_IN_DETECTION) when fewer than
    50 points are found, InvalidInputError (FIELD_NOT_FINITE).
    """
    require_box_in_scene(scene, detection)
    positions = _camera_positions(detection, options.scene_camera_distance, options.views, turn, up_axis)
    points = _trace_views(scene, detection, positions, options)
    points = points[_above_ground(points, detection, options, up_axis)]
    require_surface(len(points), of_object=False)
    return _with_normals(scene, points)


def sample_object(
    obj: SdfField, options: SamplingOptions, turn: float = 0.0, extent: OrientedBox | None = None, up_axis: Axis = "z"
) -> SurfaceSamples:
    """Points of the object's surface. Object frame, object units.

    The cameras stand around the object's surface, not around the field's bounds, which may be much larger.
    ``extent`` is that surface's bounding box, where it is known already.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT), InvalidInputError (FIELD_NOT_FINITE).
    """
    extent = extent or surface_bounds(obj)
    positions = _camera_positions(extent, options.object_camera_distance, options.views, turn, up_axis)
    points = _trace_views(obj, extent, positions, options)
    require_surface(len(points), of_object=True)
    return _with_normals(obj, points)


def _camera_positions(box: OrientedBox, distance: float, views: int, turn: float, up_axis: Axis) -> Tensor:
    """(views, 3) where the cameras stand, outside the box."""
    return camera_positions(box.center, max(distance, _CLEARANCE * box.diagonal), views, up_axis, turn)


def _trace_views(field: SdfField, box: OrientedBox, positions: Tensor, options: SamplingOptions) -> Tensor:
    """(M, 3) first surface points, seen from the cameras at ``positions`` (V, 3), within the slightly grown box.

    Memory is bounded: rays are cast in parts and followed in groups. The groups are as large as they are because
    networks around a little differently when a point is evaluated among others; one group is the usual case.
    """
    grown = OrientedBox(box.center, box.size * (1.0 + _BOX_MARGIN), box.rotation)
    parts = cast_rays(positions, box.center, grown.corners(), options.image_size, options.pixel_stride)
    clipped = (_within(field, grown, rays) for rays in parts)
    step, tolerance = shortest_step(box.diagonal), _TOLERANCE_SHARE * box.diagonal
    found = []
    while group := list(islice(clipped, _PARTS_OF_A_GROUP)):
        rays, entries, exits = zip(*group, strict=True)
        found.append(first_hits(field, Rays.cat(rays), torch.cat(entries), torch.cat(exits), step, tolerance))
    points = points_in_order(found)
    return points[grown.contains(points)]


def _within(field: SdfField, grown: OrientedBox, rays: Rays) -> tuple[Rays, Tensor, Tensor]:
    """The rays, and from where to where (N,) each is followed: a ray that misses the box, nowhere."""
    rays = rays.on(field.device)
    entry, bounds_exit = clip_to_region(rays, field.bounds[0], field.bounds[1])
    local = Rays(grown.to_local(rays.origins), rays.directions @ grown.rotation.to(rays.directions))
    box_entry, box_exit = clip_to_region(local, -grown.size / 2, grown.size / 2)
    # A ray starts at the camera, since surface before the box occludes it, and ends where it leaves the box.
    return rays, entry, torch.where(box_exit > box_entry, torch.minimum(bounds_exit, box_exit), -1.0)


def in_detection(points: Tensor, detection: OrientedBox, options: SamplingOptions, up_axis: Axis = "z") -> Tensor:
    """(N,) bool: which points (N, 3) of the scene lie in the slightly grown box and above the ground."""
    return detection.contains(points, _BOX_MARGIN) & _above_ground(points, detection, options, up_axis)


def _above_ground(points: Tensor, detection: OrientedBox, options: SamplingOptions, up_axis: Axis) -> Tensor:
    """(N,) bool: which points are above the lowest ``ground_fraction`` of the box's height."""
    up = axis_vector(up_axis)
    heights = detection.corners() @ up
    ground = heights.min() + options.ground_fraction * (heights.max() - heights.min())
    return points @ up.to(points) >= ground.to(points)


def _with_normals(field: SdfField, points: Tensor) -> SurfaceSamples:
    _, gradient = field.signed_distance_and_gradient(points)
    return SurfaceSamples(points, torch.nn.functional.normalize(gradient.to(points), dim=-1))
