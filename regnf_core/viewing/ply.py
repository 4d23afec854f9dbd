"""Point clouds as binary little-endian PLY, which every viewer reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar"}


def write_ply(
    path: Path, points: NDArray[np.float32 | np.float64], normals: NDArray[Any], colors: NDArray[np.uint8]
) -> None:
    """Write points (N, 3) in their own precision, unit normals (N, 3) and colors (N, 3), 0 to 255."""
    columns = {
        **dict.fromkeys(("x", "y", "z"), "f8" if points.dtype == np.float64 else "f4"),
        **dict.fromkeys(("nx", "ny", "nz"), "f4"),
        **dict.fromkeys(("red", "green", "blue"), "u1"),
    }
    vertices = np.empty(points.shape[0], dtype=[(name, f"<{code}") for name, code in columns.items()])
    for name, values in zip(columns, np.hstack([points.astype(np.float64), normals, colors]).T, strict=True):
        vertices[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {vertices.size}",
        *(f"property {_TYPES[code]} {name}" for name, code in columns.items()),
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())
