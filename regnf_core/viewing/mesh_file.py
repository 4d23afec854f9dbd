"""The meshes that people look at as GLB files of one fixed form.

A file has one node (with a translation, where it lies far from the origin), one primitive of triangles, positions,
perhaps normals (without them it is flat), perhaps colors (as displays show them, like all meshes that regnf writes),
indices of 32 bits.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.schema.similarity import local_origin

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_VERTICES, _INDICES = 34962, 34963
_HEAD = struct.Struct("<5I")


@dataclass(frozen=True)
class _Form:
    """All that a file's JSON depends on."""

    vertices: int
    triangles: int
    normals: bool
    colors: bool
    low: tuple[float, ...]
    high: tuple[float, ...]
    origin: tuple[float, float, float] | None

    @property
    def sections(self) -> list[tuple[str, int]]:
        """What lies in the binary part, one after the other, and how many bytes each has."""
        found = [("POSITION", 12 * self.vertices)]
        if self.normals:
            found.append(("NORMAL", 12 * self.vertices))
        if self.colors:
            found.append(("COLOR_0", 4 * self.vertices))
        return [*found, ("indices", 12 * self.triangles)]

    def text(self) -> bytes:
        """The JSON part, filled up with spaces to a multiple of four bytes."""
        accessors, views, at = [], [], 0
        for number, (name, size) in enumerate(self.sections):
            target = _INDICES if name == "indices" else _VERTICES
            views.append({"buffer": 0, "byteOffset": at, "byteLength": size, "target": target})
            accessors.append({"bufferView": number} | self._accessor(name))
            at += size
        attributes = {name: number for number, (name, _) in enumerate(self.sections[:-1])}
        primitive = {"attributes": attributes, "indices": len(attributes), "mode": 4}
        document = {
            "asset": {"version": "2.0", "generator": "regnf"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0} if self.origin is None else {"mesh": 0, "translation": list(self.origin)}],
            "meshes": [{"primitives": [primitive]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": at}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        return text + b" " * (-len(text) % 4)

    def _accessor(self, name: str) -> dict[str, Any]:
        match name:
            case "POSITION":
                ends = {"min": list(self.low), "max": list(self.high)}
                return {"componentType": _FLOAT, "count": self.vertices, "type": "VEC3"} | ends
            case "NORMAL":
                return {"componentType": _FLOAT, "count": self.vertices, "type": "VEC3"}
            case "COLOR_0":
                return {"componentType": _BYTE, "normalized": True, "count": self.vertices, "type": "VEC4"}
        return {"componentType": _INDEX, "count": 3 * self.triangles, "type": "SCALAR"}


def mesh_file(
    vertices: NDArray[Any],
    faces: NDArray[Any],
    normals: NDArray[Any] | None = None,
    colors: NDArray[Any] | None = None,
) -> bytes:
    """The GLB of a mesh. vertices, normals: (V, 3) · faces: (F, 3) · colors: (V, 3) in [0, 1].

    Positions have single precision. So of vertices far from the origin the node's translation has the larger part.
    """
    origin = local_origin([vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()])
    points = np.ascontiguousarray(vertices if origin is None else vertices - np.array(origin), "<f4")
    low, high = (tuple(float(end) for end in ends) for ends in (points.min(axis=0), points.max(axis=0)))
    form = _Form(len(points), len(faces), normals is not None, colors is not None, low, high, origin)
    parts = [points.tobytes()]
    if normals is not None:
        parts.append(np.ascontiguousarray(normals, "<f4").tobytes())
    if colors is not None:
        levels = np.full((len(points), 4), 255, np.uint8)
        levels[:, :3] = np.rint(np.clip(colors, 0.0, 1.0) * 255.0)
        parts.append(levels.tobytes())
    parts.append(np.ascontiguousarray(faces, "<u4").tobytes())
    text, data = form.text(), b"".join(parts)
    whole = _HEAD.size + len(text) + 8 + len(data)
    head = _HEAD.pack(_MAGIC, 2, whole, len(text), _JSON) + text + struct.pack("<2I", len(data), _BINARY)
    return head + data
