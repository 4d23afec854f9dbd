"""What every family does with the uploader's description."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import shift_rows

UNIT_CUBE = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
_SHARED = frozenset(
    {
        "family",
        "bounds",
        "world_scale",
        "sign",
        "up_axis",
        "label",
        "frame",
        "dataset_transform",
        "accept_implausible",
        "as",
        "cameras",
        "color",
    }
)
"""Entries that mean something for every family."""


def shared_entries(
    overrides: UploadDescription,
    bounds: Sequence[Sequence[float]],
    world_scale: float = 1.0,
    sign: int = 1,
) -> dict[str, Any]:
    """The entries of a safe field's description that all kinds share.

    bounds: lowest and highest corner in the coordinates of the checkpoint's function · world_scale: length of one unit
    of those coordinates in the family's own unit · sign: -1 where the family's functions are negative in free space.
    What ``overrides`` says goes before.
    """
    scale = world_scale * (overrides.world_scale or 1.0)
    return {
        "bounds": overrides.bounds or [[scale * value for value in corner] for corner in bounds],
        "world_scale": scale,
        "sign": overrides.sign or sign,
        "up_axis": overrides.up_axis,
        "label": overrides.label,
    }


def entries_at(entries: dict[str, Any], origin: Sequence[float] | None) -> dict[str, Any]:
    """The shared entries of a function whose coordinates begin at ``origin``, a place in those of the file.

    The field stays in the file's frame: its placement adds the origin again, in float64. None: nothing was subtracted.
    """
    if origin is None:
        return entries
    shift = [entries["world_scale"] * value for value in origin]
    own = [[value - by for value, by in zip(corner, shift, strict=True)] for corner in entries["bounds"]]
    return entries | {"placement": {"transform": shift_rows(shift), "bounds": own}}


def assumed_bounds(overrides: UploadDescription) -> tuple[str, ...]:
    """Why the unit cube bounds a field that trains in the unit sphere; nothing where other bounds are said."""
    return () if overrides.bounds else ("bounds [-1, 1]: the unit sphere's cube, in which it trains",)


def refuse_other_entries(overrides: UploadDescription, family: str, meant: Sequence[str] = ()) -> None:
    """Raise FieldFormatError (INVALID_DESCRIPTION) for an entry that neither all families share nor is ``meant``."""
    others = [name for name, value in overrides.non_default().items() if name not in _SHARED and name not in meant]
    if others:
        raise FieldFormatError(f"description.{others[0]} means nothing for {family}", reason="INVALID_DESCRIPTION")


def require_family(overrides: UploadDescription, family: str) -> None:
    """Raise FieldFormatError (FAMILY_NOT_SUPPORTED) if ``overrides`` names another family than the file's."""
    if overrides.family not in (None, family):
        message = f"the file is {family}, the description says {overrides.family}"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")


def contradiction(name: str, said: object, found: object) -> FieldFormatError:
    """The error for an entry of the settings or the description that the tensors exclude: both values, by name."""
    message = f"{name}: the settings or the description say {said}, the tensors have {found}"
    return FieldFormatError(message, reason="SETTINGS_CONTRADICT_TENSORS")
