"""Schemas that routes name in the contract by hand: naming one enters it into the contract."""

from __future__ import annotations

from typing import Any

REFERENCED: dict[str, type] = {}
"""Every model that was named, by its name in the contract."""


def reference(model: type) -> dict[str, Any]:
    """A reference to a model's schema; the contract lists the schema itself."""
    REFERENCED[model.__name__] = model
    return {"$ref": f"#/components/schemas/{model.__name__}"}
