"""The families of checkpoints that the importer recognizes: one module a family, listed in ``FAMILIES``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families import (
    deepsdf,
    instant_nsr_pl,
    neuralangelo,
    neus,
    pin_slam,
    sdfstudio,
    siren,
    splatfacto,
    unsupported,
    wrappers,
)
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.pickle.pickle_machine import GlobalRef, Placeholder
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

Family = Callable[[dict[Any, Any], TensorSource, UploadDescription], ConvertedField | None]
"""Takes a checkpoint's top-level dictionary. Returns None unless it is the family's; raises FieldFormatError if it is
but cannot be taken."""

FAMILIES: tuple[Family, ...] = (
    sdfstudio.convert,
    neus.convert,
    instant_nsr_pl.convert,
    neuralangelo.convert,
    deepsdf.convert,
    deepsdf.convert_blocks,
    siren.convert,
    pin_slam.convert,
    splatfacto.convert,
    unsupported.refuse,
)

_SHOWN_KEYS = 8


def convert_checkpoint(checkpoint: Any, source: TensorSource, description: UploadDescription) -> ConvertedField:
    """The checkpoint's signed distance field. Everything the field does not need is left behind.

    Raises FieldFormatError: UNSAFE_GLOBAL_IN_WEIGHTS, FIELD_NOT_RECOGNIZED, FAMILY_NOT_SUPPORTED, and what the family
    raises.
    """
    if isinstance(checkpoint, (Placeholder, GlobalRef)):
        message = f"the file has an object of {checkpoint.full_name} instead of weights; save its state_dict()"
        raise FieldFormatError(message, reason="UNSAFE_GLOBAL_IN_WEIGHTS")
    checkpoint = wrappers.unwrapped(checkpoint, description.family)
    if isinstance(checkpoint, dict):
        for family in FAMILIES:
            converted = family(checkpoint, source, description)
            if converted is not None:
                return converted
    raise FieldFormatError(
        f"the family of the field is unknown; {_contents(checkpoint)}", reason="FIELD_NOT_RECOGNIZED"
    )


def _contents(checkpoint: object) -> str:
    """A few words on what is there instead, never a value's own text."""
    if not isinstance(checkpoint, dict):
        return f"the file has a {type(checkpoint).__name__}"
    keys = [key[:40] for key in checkpoint if isinstance(key, str) and key.isprintable()][:_SHOWN_KEYS]
    return f"its first keys are {keys}"
