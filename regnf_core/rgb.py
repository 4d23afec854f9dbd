"""A color in plain numbers, as options and requests hold it."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Le
from pydantic import FiniteFloat

_Share = Annotated[FiniteFloat, Ge(0), Le(1)]
Rgb = tuple[_Share, _Share, _Share]
"""As it is shown (sRGB), each part 0..1."""
