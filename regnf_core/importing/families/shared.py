"""What every family does with the uploader's description."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.upload_description import UploadDescription

UNIT_CUBE = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
_SHARED = frozenset({"family", "bounds", "world_scale", "sign", "up_axis", "label"})
"""Entries that mean something for every family."""


def shared_entries(
    wanted: UploadDescription,
    bounds: Sequence[Sequence[float]],
    world_scale: float = 1.0,
    sign: int = 1,
) -> dict[str, Any]:
    """The entries of a safe field's description that all kinds share.

    bounds: lowest and highest corner in the coordinates of the checkpoint's function · world_scale: length of one unit
    of those coordinates in the family's own unit · sign: -1 where the family's functions are negative in free space.
    What ``wanted`` says goes before.
    """
    scale = world_scale * (wanted.world_scale or 1.0)
    return {
        "bounds": wanted.bounds or [[scale * value for value in corner] for corner in bounds],
        "world_scale": scale,
        "sign": wanted.sign or sign,
        "up_axis": wanted.up_axis,
        "label": wanted.label,
    }


def refuse_other_entries(wanted: UploadDescription, family: str, meant: Sequence[str] = ()) -> None:
    """Raise FieldFormatError (INVALID_DESCRIPTION) if ``wanted`` has an entry that is neither shared nor ``meant``."""
    said = [name for name, value in wanted.said().items() if name not in _SHARED and name not in meant]
    if said:
        raise FieldFormatError(f"description.{said[0]} means nothing for {family}", reason="INVALID_DESCRIPTION")


def require_family(wanted: UploadDescription, family: str) -> None:
    """Raise FieldFormatError (FAMILY_NOT_SUPPORTED) if ``wanted`` names another family than the file's."""
    if wanted.family not in (None, family):
        message = f"the file is {family}, the description says {wanted.family}"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
