"""Point clouds as binary little-endian PLY, which every viewer reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)


def write_ply(path: Path, points: NDArray[np.float32], normals: NDArray[np.float32], colors: NDArray[np.uint8]) -> None:
    """Write points (N, 3), unit normals (N, 3) and colors (N, 3), 0 to 255."""
    vertices = np.empty(points.shape[0], dtype=_VERTEX)
    for names, values in (
        (("x", "y", "z"), points),
        (("nx", "ny", "nz"), normals),
        (("red", "green", "blue"), colors),
    ):
        for column, name in enumerate(names):
            vertices[name] = values[:, column]
    properties = [
        f"property {'uchar' if _VERTEX[name].itemsize == 1 else 'float'} {name}" for name in _VERTEX.names or ()
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {vertices.size}",
        *properties,
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())
