"""The colors of a glTF document's vertices: their own times the material's, linear light as sRGB. No textures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes.geometry import Float64Array, within_unit
from regnf_core.importing.meshes.glb_buffers import Accessors

_GRAY = 0.8
"""Of parts without any color, beside others that have one."""


def primitive_colors(
    document: dict[str, Any], primitive: dict[str, Any], accessors: Accessors, vertices: int
) -> Float64Array | None:
    """(V, 3) in [0, 1], R, G, B, of one primitive; None where it has none, or none that makes sense."""
    try:
        own = _own_colors(document, primitive, accessors)
        factor = _factor(document, primitive)
    except (AttributeError, FieldFormatError, IndexError, KeyError, OverflowError, TypeError, ValueError):
        return None
    if own is None and factor is None:
        return None
    linear = np.ones((vertices, 3)) if own is None else own
    if len(linear) != vertices:
        return None
    return _as_srgb(within_unit(linear * (1.0 if factor is None else factor)))


def joined_colors(parts: Sequence[Float64Array | None], counts: Sequence[int]) -> Float64Array | None:
    """The colors of all vertices; None where no part has any. counts: vertices of each part."""
    if all(part is None for part in parts):
        return None
    filled = [np.full((count, 3), _GRAY) if part is None else part for part, count in zip(parts, counts, strict=True)]
    return np.concatenate(filled)


def _own_colors(document: dict[str, Any], primitive: dict[str, Any], accessors: Accessors) -> Float64Array | None:
    number = primitive["attributes"].get("COLOR_0")
    if number is None:
        return None
    width = 4 if document["accessors"][number]["type"] == "VEC4" else 3
    return accessors.array(number, width)[:, :3]


def _factor(document: dict[str, Any], primitive: dict[str, Any]) -> Float64Array | None:
    """The material's base color, linear light; None where there is none, or a texture has it."""
    if "material" not in primitive:
        return None
    surface = document["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
    if "baseColorTexture" in surface or "baseColorFactor" not in surface:
        return None
    return np.array(surface["baseColorFactor"][:3], dtype=np.float64).reshape(3)


def _as_srgb(linear: Float64Array) -> Float64Array:
    """IEC 61966-2-1: images have such numbers, glTF has linear light."""
    curved: Float64Array = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return curved
