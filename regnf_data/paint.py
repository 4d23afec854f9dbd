"""What color a mesh has at a point of its surface. All colors are linear, not sRGB, from 0 to 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

_GRAY = (0.5, 0.5, 0.5)


class Paint(Protocol):
    """Colors of surface points."""

    def at(
        self, points: NDArray[np.float64], corners: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Colors (P, 3) at points (P, 3), each the mix by ``shares`` (P, 3) of a triangle's vertices (P, 3)."""
        ...


@dataclass(frozen=True)
class VertexPaint:
    """One color a vertex, (V, 3), mixed over the triangle."""

    colors: NDArray[np.float64]

    def at(
        self, points: NDArray[np.float64], corners: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Colors (P, 3)."""
        del points
        mixed: NDArray[np.float64] = np.einsum("pk,pkc->pc", shares, self.colors[corners])
        return mixed


@dataclass(frozen=True)
class TexturePaint:
    """A picture (h, w, 3) laid on by texture coordinates (V, 2); (0, 0) is its lower left corner, and it repeats."""

    picture: NDArray[np.float32]
    coordinates: NDArray[np.float64]

    def at(
        self, points: NDArray[np.float64], corners: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Colors (P, 3), of the nearest texel."""
        del points
        u, v = np.einsum("pk,pkc->cp", shares, self.coordinates[corners])
        height, width = self.picture.shape[:2]
        column = np.floor(u * width).astype(np.int64) % width
        row = np.floor((1.0 - v) * height).astype(np.int64) % height
        texels: NDArray[np.float64] = self.picture[row, column].astype(np.float64)
        return texels


@dataclass(frozen=True)
class TilePaint:
    """Cubes of two colors (3,) in turn, ``edge`` long: what floors and walls wear, so that images show them move."""

    first: tuple[float, float, float]
    second: tuple[float, float, float]
    edge: float

    def at(
        self, points: NDArray[np.float64], corners: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Colors (P, 3)."""
        del corners, shares
        # Off the faces by a part of a tile: rounding must not choose the color.
        odd = np.floor(points / self.edge + 0.3).sum(axis=1) % 2 == 1
        colors: NDArray[np.float64] = np.where(odd[:, None], self.first, self.second)
        return colors


def paint_of(mesh: Any) -> Paint:
    """The paint that a trimesh mesh comes with: its base texture, its vertices' or faces' colors, or else gray."""
    visual = mesh.visual
    material = getattr(visual, "material", None)
    coordinates = getattr(visual, "uv", None)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is not None and coordinates is not None and len(coordinates) == len(mesh.vertices):
        factor = getattr(material, "baseColorFactor", None)
        tint = 1.0 if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255.0
        linear = to_linear(np.asarray(picture.convert("RGB"))) * tint
        return TexturePaint(linear.astype(np.float32), np.asarray(coordinates, dtype=np.float64))
    plain = visual.kind in (None, "texture")
    main = getattr(material, "main_color", None) if plain else None
    if plain and main is None:
        return VertexPaint(np.tile(_GRAY, (len(mesh.vertices), 1)))
    colors = np.tile(main, (len(mesh.vertices), 1)) if main is not None else np.asarray(visual.vertex_colors)
    return VertexPaint(to_linear(colors[:, :3]))


def to_linear(srgb: NDArray[Any]) -> NDArray[np.float64]:
    """sRGB bytes to linear light, 0 to 1 (IEC 61966-2-1)."""
    steps = np.arange(256) / 255.0
    table = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    linear: NDArray[np.float64] = table[srgb.astype(np.uint8)]
    return linear


def to_srgb(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear light, 0 to 1, to sRGB bytes (IEC 61966-2-1)."""
    light = np.clip(linear, 0.0, 1.0)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.round(encoded * 255.0).astype(np.uint8)
