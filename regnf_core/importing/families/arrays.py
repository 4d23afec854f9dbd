"""The families of .npz files that the importer recognizes: one module a family, listed in ``ARRAY_FAMILIES``."""

from __future__ import annotations

from collections.abc import Callable

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families import dense_grid, voxel_block_grid
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.upload_description import UploadDescription

ArrayFamily = Callable[[ArraySource, UploadDescription], ConvertedField | None]
"""Returns None unless the arrays are the family's; raises FieldFormatError if they are but cannot be taken."""

ARRAY_FAMILIES: tuple[ArrayFamily, ...] = (voxel_block_grid.convert, dense_grid.convert)

_SHOWN_NAMES = 8


def convert_arrays(arrays: ArraySource, description: UploadDescription) -> ConvertedField:
    """The signed distance field in the arrays. Those that it does not need are never unpacked.

    Raises FieldFormatError: FIELD_NOT_RECOGNIZED, FAMILY_NOT_SUPPORTED and what the family raises.
    """
    for family in ARRAY_FAMILIES:
        converted = family(arrays, description)
        if converted is not None:
            return converted
    if all(name in arrays for name in ("links", "density_data", "sh_data")):
        message = (
            "these are the arrays of Plenoxels, a radiance field without distances; it is not supported: render depth "
            "images and fuse them (regnf fuse), or extract its mesh, and give the mesh"
        )
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    names = [name[:40] for name in arrays.names if name.isprintable()][:_SHOWN_NAMES]
    message = f"the family of the field is unknown; the first arrays are {names}"
    raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")
