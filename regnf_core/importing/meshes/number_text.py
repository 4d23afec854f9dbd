"""Numbers between spaces, as many text formats have them."""

from __future__ import annotations

import warnings

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, not_numbers


def numbers_of(text: bytes, format_: str) -> Float64Array:
    """All numbers of a text. Raises FieldFormatError (MESH_INVALID) where a word is none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.fromstring(text.decode("ascii"), dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise not_numbers(f"the {format_} file holds a word that is not a number", text) from error
