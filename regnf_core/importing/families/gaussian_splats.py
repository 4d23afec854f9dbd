"""Gaussian splats as fields: depths that cameras see of them, fused to a map of truncated distances with weights.

The cameras are those of the training where they came with the file; else some are placed around an object, or in the
free space of a scene. Depths that other views contradict, as floaters have them, are left out, and so are those of
splats that are seen from behind.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from regnf_core.importing.assumptions import GLTF, PLACES, RUB, UNIT, Assumptions
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import refuse_other_entries, require_family
from regnf_core.importing.families.seen_surface import VOXELS, fused_field, into_file, workers
from regnf_core.importing.meshes.scene import refuse_node
from regnf_core.importing.meshes.triangle_files import Siblings, malformed
from regnf_core.importing.splats.drawing import prepared
from regnf_core.importing.splats.gaussians import Splats, sound
from regnf_core.importing.splats.packed import read_ksplat, read_splat, read_spz
from regnf_core.importing.splats.tables import read_gltf_splats, read_ply_splats, read_sog
from regnf_core.importing.splats.views import (
    Region,
    Trained,
    agreed,
    cameras_for,
    drawn,
    given_cameras,
    region_of,
    touching,
)
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import local_origin

FAMILY = "gaussian_splats"
ASSUMPTIONS = {"spz": (UNIT, RUB), "sog": (UNIT, RUB), "glb": GLTF, "gltf": GLTF}
"""Of formats that define more than numbers."""
_VOXELS_WITHIN = 512
"""Along the longest edge of the region of a scene, in which things are a part of it."""


def read_splats(format_: str, data: memoryview, siblings: Siblings, node: str | None = None) -> Splats:
    """The Gaussians of a file of the format that ``sniff_format`` named, as they are stored. node: of a glTF scene, the
    node to read.

    Raises FieldFormatError: MESH_INVALID, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED.
    """
    if format_ == "sog":
        refuse_node(node, format_)
        return read_sog(data, siblings)
    if format_ in ("glb", "gltf"):
        found = read_gltf_splats(data, siblings, node)
        if found is None:
            raise malformed("the glTF file has no Gaussians")
        return found
    refuse_node(node, format_)
    readers = {"splat-ply": read_ply_splats, "splat": read_splat, "ksplat": read_ksplat, "spz": read_spz}
    return readers[format_](data)


def convert_splats(
    splats: Splats,
    origin: str,
    overrides: UploadDescription,
    cameras: Trained | None,
    tensor_bytes: int,
    assumes: Assumptions = PLACES,
) -> ConvertedField:
    """The field of Gaussians. origin: what they were read from · cameras: of their training ·
    assumes: what their file does not say.

    Raises FieldFormatError: MESH_INVALID, NO_ZERO_LEVEL where no camera sees a surface, and what ``overrides`` is
    refused for.
    """
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("as", "cameras", "node"))
    splats, lost = sound(splats)
    scale = overrides.world_scale or 1.0
    within = None if overrides.as_ is None else overrides.as_ == "scene"
    bounds = None if overrides.bounds is None else np.array(overrides.bounds) / scale
    region = region_of(splats, bounds, within)
    shown = touching(splats)
    near = local_origin([region.low.tolist(), region.high.tolist()])
    shift = np.array(near or (0.0, 0.0, 0.0))
    splats = replace(splats, means=splats.means - shift).chosen(shown)
    region = replace(region, low=region.low - shift, high=region.high - shift)
    voxels = _VOXELS_WITHIN if region.within else VOXELS
    voxel = region.longest / voxels
    if cameras is None:
        placed = cameras_for(splats, region)
    else:
        placed = given_cameras(cameras, into_file(overrides, cameras, shift))
    alone = cameras is None and not region.within
    views, share = agreed(drawn(prepared(splats), placed, voxel, workers()), voxel, alone, cameras is None)
    fused = fused_field(views, region, alone, overrides, tensor_bytes, near, voxels)
    floating = len(shown) - len(splats)
    kind = "surfels (2D Gaussians)" if splats.flat else "Gaussians"
    why = (
        f"{origin}: {len(shown):,} {kind}, {splats.harmonics.shape[1]} coefficients of color each",
        _from_where(region, cameras, len(views)),
        fused.why[-1],
    )
    text = (
        f"the surface is where half of the light is stopped, in depths of {len(views)} views, fused to voxels of "
        f"1/{voxels} of the longest edge; left out were {floating:,} Gaussians apart from all others, and "
        f"{100 * share:.1f} % of the depths, which other views contradicted"
    )
    warnings = [f"SURFACE_RECONSTRUCTED: {text}"]
    if lost:
        warnings.append(f"PARTS_LEFT_OUT: {lost} Gaussians with NaN, infinity or no rotation")
    description = {**fused.description, "source": {"family": FAMILY}}
    return replace(fused, family=FAMILY, why=why, description=description, warnings=tuple(warnings), assumes=assumes)


def _from_where(region: Region, cameras: Trained | None, count: int) -> str:
    if cameras is not None:
        return f"seen from {count} of the {len(cameras)} cameras that came with it"
    if region.within:
        return f"seen in {count} views from places in its free space, as a scene; if it is an object, give as: object"
    return f"seen in {count} views from around it, as an object; if it is a scene, give as: scene"
