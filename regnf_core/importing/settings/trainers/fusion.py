"""Maps of truncated distances (Open3D, nvblox, KinectFusion's kin): the truncation in the YAML of a run."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_PARTS = ("", "integrate.", "integration.", "tsdf.", "mapper.", "mapping.")
_LENGTHS = ("sdf_trunc", "truncation", "truncation_distance", "trunc_distance")
_IN_VOXELS = ("trunc_voxel_multiplier", "projective_integrator_truncation_distance_vox", "truncation_distance_vox")
_VOXEL = ("voxel_size", "voxel_size_m", "voxel_length")


def main_file(documents: Documents) -> Keys | None:
    """The first file that names a truncation."""
    return next((keys for keys in mappings(documents) if _first(keys, (*_LENGTHS, *_IN_VOXELS))), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError (SETTINGS_MALFORMED)."""
    length, voxels, voxel = (_first(keys, names) for names in (_LENGTHS, _IN_VOXELS, _VOXEL))
    if length:
        said.put("truncation", keys.number(length), keys, length)
    elif voxels and voxel:
        said.put("truncation", (keys.number(voxels) or 0.0) * (keys.number(voxel) or 0.0), keys, voxels)
        said.note(keys, voxel)


def _first(keys: Keys, names: tuple[str, ...]) -> str | None:
    return next((f"{part}{name}" for part in _PARTS for name in names if keys.has(f"{part}{name}")), None)
