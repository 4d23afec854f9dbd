"""What a family makes of a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.importing.tensors import Float32Array


@dataclass(frozen=True)
class ConvertedField:
    """A field ready to be written: the safe file's description and tensors, and how the family was told."""

    family: str
    why: tuple[str, ...]
    """The evidence, one short sentence each."""
    description: dict[str, Any]
    tensors: dict[str, Float32Array]
    warnings: tuple[str, ...] = ()
