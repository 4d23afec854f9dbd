"""The columns of a direction's sines and cosines: how many there are, and in which order we keep them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnf_core.importing.families.color.head import understood
from regnf_core.importing.families.network import Order, encoding_order

MAX_DEGREE = 24


def degree_of(columns: int, said: int | None = None) -> int:
    """Frequencies of a direction's encoding with so many columns: the direction and its sines and cosines.

    Raises FieldFormatError (FAMILY_NOT_SUPPORTED) for columns of anything else, or another number than was said.
    """
    degree, rest = divmod(columns - 3, 6)
    understood(
        rest == 0 and 0 <= degree <= MAX_DEGREE, f"{columns} columns for the direction, expected 3 + 6 a frequency"
    )
    understood(said in (None, degree), f"{degree} frequencies of the direction, the description says {said}")
    return degree


def our_order(degree: int, order: Order, direction_first: bool) -> npt.NDArray[np.int64]:
    """Where in the trainer's columns each of ours is: direction, sines, cosines."""
    sines = encoding_order(order, degree, 6 * degree)
    if direction_first:
        return np.concatenate((np.arange(3), 3 + sines))
    return np.concatenate((6 * degree + np.arange(3), sines))
