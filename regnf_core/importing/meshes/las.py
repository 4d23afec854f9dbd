"""LAS and LAZ: clouds of laser scanners, read by laspy in parts."""

from __future__ import annotations

import io
import struct

import numpy as np

from regnf_core.importing.assumptions import AXES, LAS
from regnf_core.importing.meshes.thinning import Thinning
from regnf_core.importing.meshes.triangle_files import Geometry, malformed, unsupported

_AT_ONCE = 500_000
_HEADER, _SIZES_AT, _RECORD = 227, 94, 54
"""Bytes of the smallest header and of a record's own header; where its size, the points' place and the count of records
stand."""


def read_las(data: memoryview) -> Geometry:
    """The points of a LAS or LAZ file, in the unit of its coordinates. Memory does not grow with their number.

    Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED.
    """
    import laspy

    _require_header(data)
    points = []
    try:
        with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as file:
            count = file.header.point_count
            thinning, read = Thinning(count), 0
            scales, offsets = np.array(file.header.scales), np.array(file.header.offsets)
            if not (np.isfinite(scales).all() and np.isfinite(offsets).all() and (scales != 0.0).all()):
                raise malformed("the LAS header has an invalid scale or offset")
            for part in file.chunk_iterator(_AT_ONCE):
                kept = thinning.kept(read, read + len(part))
                points.append(np.column_stack([part.X, part.Y, part.Z])[kept] * scales + offsets)
                read += len(part)
    except laspy.errors.LaspyException as error:
        raise malformed(f"the LAS file cannot be read: {error}") from error
    except NotImplementedError as error:
        raise unsupported(f"the LAS file has a part that is not supported: {error}") from error
    except (ValueError, OverflowError, MemoryError, RuntimeError, EOFError, OSError) as error:
        raise malformed("the LAS file ends early or is damaged") from error
    found = np.concatenate(points) if points else np.zeros((0, 3))
    if read < count:
        raise malformed(f"the LAS file ends before the {count} points of its header")
    return Geometry(found, np.zeros((0, 3), np.int64), left_out=thinning.left_out, assumes=(LAS, AXES))


def _require_header(data: memoryview) -> None:
    """Raise FieldFormatError (MESH_INVALID) for counts that the file has no room for: the library would read them."""
    if len(data) < _HEADER:
        raise malformed("the LAS file ends within its header")
    header_size, start, records = struct.unpack_from("<HII", data, _SIZES_AT)
    if not _HEADER <= header_size <= start <= len(data) or records * _RECORD > start - header_size:
        raise malformed("the LAS header has sizes that do not fit the file")
