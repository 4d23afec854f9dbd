"""Radiance fields as fields: the depths that the cameras of the training see of the density, fused to a map.

What stops half of the light is the surface. It is no distance that anybody trained: thin fog, floaters and what no
image shows become surfaces too, unless other views contradict them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import PLACES, Assumptions
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.seen_surface import VOXELS, fused_field, into_file, workers
from regnf_core.importing.radiance.density import RadianceField
from regnf_core.importing.radiance.depths import depth_images, sampled
from regnf_core.importing.splats.gaussians import Doubles
from regnf_core.importing.splats.views import Region, Seen, Trained, agreed, given_cameras
from regnf_core.importing.upload_description import UploadDescription

_FEW, _SMALL, _COARSE = 24, 1 << 12, 96
"""Cameras, pixels of each, and nodes along the longest edge, from which the region is told."""
_MOST_CAMERAS, _PIXELS = 64, 20_000
_SHARE = 0.01
"""Of the ends of depths, what may lie beyond the region on each side."""
_MARGIN = 0.03
"""Of the diagonal of their box, on every side."""
_DOUBTFUL = 0.5
"""Share of cameras that see nothing or stand in matter, or of depths that are contradicted: of another frame."""
_AT_ONCE = 2.0
"""A camera stands in matter if it sees no farther than so many times the nearest that was trained."""
WITHOUT_CAMERAS = (
    "a radiance field has no surface of its own: give the cameras of its training (regnf convert --cameras "
    "transforms.json, or put that file into the run's folder, beside dataparser_transforms.json); or render depth "
    "images (ns-render) and fuse them (regnf fuse), or export a mesh (ns-export tsdf or poisson)"
)


@dataclass(frozen=True, eq=False)
class Radiance:
    """A density as a file has it. reach: lowest and highest corner of where a surface is looked for, unless there are
    bounds · why: how it was recognized · assumes: what the file does not say."""

    family: str
    field: RadianceField
    reach: tuple[Doubles, Doubles]
    why: str
    warnings: tuple[str, ...] = ()
    assumes: Assumptions = PLACES


def surface_of(
    radiance: Radiance, cameras: Trained | None, overrides: UploadDescription, tensor_bytes: int, most_s: float
) -> ConvertedField:
    """The field of what the cameras see. most_s: seconds that the density may take.

    Raises FieldFormatError: CAMERAS_NOT_RECOGNIZED where there are none, CAMERAS_OF_ANOTHER_FRAME, NO_ZERO_LEVEL,
    IMPORT_TOO_COSTLY.
    """
    if cameras is None:
        raise FieldFormatError(f"{radiance.family}: {WITHOUT_CAMERAS}", reason="CAMERAS_NOT_RECOGNIZED")
    if (seconds := VOXELS**3 * radiance.field.seconds) > most_s:
        message = f"the density may take an estimated {seconds:.0f} s in {VOXELS}^3 places; {most_s:g} s are allowed"
        raise FieldFormatError(message, reason="IMPORT_TOO_COSTLY")
    field, T_file_field = radiance.field, into_file(overrides, cameras, np.zeros(3))
    region = _region(radiance, cameras, T_file_field, overrides)
    placed = given_cameras(cameras, T_file_field, _MOST_CAMERAS, _PIXELS)
    voxel = region.longest / VOXELS
    lattice = sampled(field, region.low, region.high, VOXELS, workers())
    depths = depth_images(lattice, placed, field.near, workers())
    seen = [Seen(camera, depth, None) for camera, depth in zip(placed, depths, strict=True)]
    ends = [float(np.median(depth[depth > 0.0])) if depth.any() else 0.0 for depth in depths]
    blind = [end <= _AT_ONCE * field.near and (end > 0.0 or overrides.bounds is None) for end in ends]
    views, share = agreed(seen, voxel, False, False)
    if not any(ends):
        message = "no camera sees a surface: less than half of the light is stopped everywhere, or they look elsewhere"
        raise FieldFormatError(message, reason="NO_ZERO_LEVEL")
    if np.mean(blind) > _DOUBTFUL or share > _DOUBTFUL:
        message = (
            f"{sum(blind)} of {len(views)} cameras are inside matter or see no surface, and {100 * share:.0f} % of the "
            f"depths are contradicted by other cameras: their poses are not in the frame of the radiance field"
        )
        raise FieldFormatError(message, reason="CAMERAS_OF_ANOTHER_FRAME")
    fused = fused_field(views, region, False, overrides, tensor_bytes)
    text = (
        f"a radiance field has a density, and no distance: the surface is where half of the light is stopped, in "
        f"depths of {len(views)} views, fused to voxels of 1/{VOXELS} of the longest edge; left out were "
        f"{100 * share:.1f} % of the depths, which other views contradicted"
    )
    return replace(
        fused,
        family=radiance.family,
        description={**fused.description, "source": {"family": radiance.family}},
        why=(radiance.why, f"seen from {len(views)} of the {len(cameras)} cameras of its training", fused.why[-1]),
        warnings=(f"SURFACE_RECONSTRUCTED: {text}", *radiance.warnings),
        assumes=radiance.assumes,
    )


def _region(radiance: Radiance, cameras: Trained, T_file_field: Doubles, overrides: UploadDescription) -> Region:
    """The bounds, or the box around what a few cameras see within the reach."""
    within = overrides.as_ == "scene"
    if overrides.bounds is not None:
        low, high = np.array(overrides.bounds) / (overrides.world_scale or 1.0)
        return Region(low, high, within)
    field, reach = radiance.field, radiance.reach
    few = given_cameras(cameras, T_file_field, _FEW, _SMALL)
    depths = depth_images(sampled(field, *reach, _COARSE, workers()), few, field.near, workers())
    ends = [Seen(camera, depth, None).ends()[depth > 0] for camera, depth in zip(few, depths, strict=True)]
    points = np.concatenate(ends)
    if not len(points):
        return Region(*reach, within)
    low, high = np.quantile(points, [_SHARE, 1.0 - _SHARE], axis=0)
    margin = _MARGIN * max(float(np.linalg.norm(high - low)), 1e-9)
    return Region(np.maximum(low - margin, reach[0]), np.minimum(high + margin, reach[1]), within)
