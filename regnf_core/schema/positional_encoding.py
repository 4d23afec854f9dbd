"""How sines and cosines of a position are described."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from annotated_types import Ge, Le


@dataclass(frozen=True)
class PositionalEncodingDescription:
    """Sines and cosines of the position; see :class:`regnf_core.fields.positional_encoding.PositionalEncoding`."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    degree: Annotated[int, Ge(0), Le(24)] = 6
    two_pi: bool = False
    used: bool = True
    """False: the network has the columns, but they were always fed zeros."""
    base_frequency: Annotated[float, Ge(1e-6), Le(1e6)] = 1.0
    """A factor of all frequencies."""
    off_axis: bool = False
    """True: of the lengths along 21 directions, those of an icosahedron, in place of the three coordinates."""

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 2 * self.degree * (21 if self.off_axis else 3)
