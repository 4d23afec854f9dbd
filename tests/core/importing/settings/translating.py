"""Settings and facts of a checkpoint, as the tests of the trainers make them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.settings.facts import Facts
from regnf_core.importing.settings.translate import Settings, translate_settings
from regnf_core.importing.upload_description import UploadDescription


def facts(shapes: dict[str, tuple[int, ...]] | None = None, **numbers: int) -> Facts:
    """Of a checkpoint with these tensors and whole numbers."""
    return Facts(numbers, {name: SimpleNamespace(shape=shape) for name, shape in (shapes or {}).items()})  # type: ignore[misc]


def translated(
    files: dict[str, str], known: Facts | None = None, said: dict[str, Any] | None = None, required: bool = True
) -> Settings:
    opened = tuple(SettingsFile(name, memoryview(text.encode())) for name, text in files.items())
    return translate_settings(opened, known or Facts(), UploadDescription.from_dict(said), required)


def linear(prefix: str, widths: list[int], inputs: list[int]) -> dict[str, tuple[int, ...]]:
    """Shapes of weight-normalized layers."""
    found: dict[str, tuple[int, ...]] = {}
    for i, (rows, columns) in enumerate(zip(widths, inputs, strict=True)):
        found |= {
            f"{prefix}{i}.bias": (rows,),
            f"{prefix}{i}.weight_g": (rows, 1),
            f"{prefix}{i}.weight_v": (rows, columns),
        }
    return found
