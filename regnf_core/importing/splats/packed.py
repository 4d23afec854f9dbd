"""Packed files of Gaussian splats: .splat, .ksplat and .spz (versions 1 to 4), by their published layouts."""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.triangle_files import malformed, unsupported
from regnf_core.importing.splats.gaussians import MAX_SPLATS, SH_DC, Doubles, Floats, Splats, smallest_three

_TERMS = (1, 4, 9, 16, 25)
"""Spherical harmonics up to each degree."""
_MOST_TERMS = 16


def require_count(count: int) -> None:
    """Raise FieldFormatError (MESH_INVALID) for no splats, or more than are taken."""
    if not 0 < count <= MAX_SPLATS:
        raise malformed(f"the file claims {count} Gaussians; 1 to {MAX_SPLATS} are allowed")


# .splat: 32 bytes each: place, scales, color and opacity, quaternion w x y z. It has no header.

_ROW = np.dtype([("place", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("turn", "u1", 4)])


def read_splat(data: memoryview) -> Splats:
    """Raises FieldFormatError (MESH_INVALID)."""
    count, rest = divmod(len(data), _ROW.itemsize)
    if rest:
        raise malformed("the .splat file ends within a Gaussian of 32 bytes")
    require_count(count)
    rows = np.frombuffer(data, _ROW, count)
    with np.errstate(all="ignore"):
        scales = np.log(rows["scale"])
    return Splats(
        rows["place"].astype(np.float64),
        scales.astype(np.float32),
        (rows["turn"].astype(np.float32) - 128.0) / 128.0,
        _shares(rows["color"][:, 3]),
        _of_colors(rows["color"][:, :3]),
    )


def _shares(levels: npt.NDArray[Any]) -> Floats:
    """Bytes as shares of 255."""
    return (levels / 255.0).astype(np.float32)


def _of_colors(levels: npt.NDArray[Any]) -> Floats:
    """(N, 1, 3): the coefficients of colors of 0 to 255."""
    found: Floats = ((levels / np.float32(255.0) - 0.5) / np.float32(SH_DC))[:, None].astype(np.float32)
    return found


# .ksplat: sections of splats, places in 16 bits round the middles of buckets, where the file is compressed.

_HEADER, _SECTION = 4096, 1024
_SPANS = {0: 0, 1: 2, 2: 1}
"""Bytes of a coefficient of the harmonics by level of compression; 0: as floats of four."""


def read_ksplat(data: memoryview) -> Splats:
    """Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED."""
    if len(data) < _HEADER:
        raise malformed("the .ksplat file ends within its header")
    major, minor = data[0], data[1]
    most, _, _, count = struct.unpack_from("<4I", data, 4)
    (level,) = struct.unpack_from("<H", data, 20)
    low, high = struct.unpack_from("<2f", data, 36)
    if (major, minor) != (0, 1) or level not in _SPANS:
        raise unsupported(f"a .ksplat file of version {major}.{minor}, compression {level}; 0.1 is read")
    require_count(count)
    if not high > low:
        low, high = -1.5, 1.5
    at, parts = _HEADER + most * _SECTION, []
    for number in range(most):
        part, at = _section(data, number, at, level, (low, high))
        parts += [] if part is None else [part]
    if not parts:
        raise malformed("the .ksplat file has no Gaussian")
    return Splats.together(parts)


def _section(
    data: memoryview, number: int, at: int, level: int, levels: tuple[float, float]
) -> tuple[Splats | None, int]:
    """The splats of a section whose buckets begin at ``at``, and where the next section's do."""
    start = _HEADER + number * _SECTION
    if start + _SECTION > len(data):
        raise malformed("the .ksplat file ends within its sections' headers")
    count, most, per_bucket, buckets = struct.unpack_from("<4I", data, start)
    block, bucket_bytes, span = struct.unpack_from("<fHxxI", data, start + 16)
    full, partial = struct.unpack_from("<2I", data, start + 32)
    (degree,) = struct.unpack_from("<H", data, start + 40)
    if degree > 2 or count > most or most > MAX_SPLATS or buckets > most + 1:
        raise malformed("a .ksplat section has invalid counts")
    extra, row = _row_of(level, _TERMS[degree] - 1)
    buckets_at = at + 4 * partial
    if full + partial > buckets or bucket_bytes % 4 or (buckets and bucket_bytes < 12):
        raise malformed("a .ksplat section has invalid counts")
    rows_at = buckets_at + buckets * bucket_bytes
    end = rows_at + most * row.itemsize
    if end > len(data):
        raise malformed("the .ksplat file ends within its Gaussians")
    if count == 0:
        return None, end
    rows = np.frombuffer(data, row, count, rows_at)
    means = rows["place"].astype(np.float64)
    if level:
        sizes = np.frombuffer(data, "<u4", partial, at)
        if full * per_bucket > most + per_bucket or int(sizes.sum(dtype=np.uint64)) > most:
            raise malformed("the .ksplat file has Gaussians outside its buckets")
        middles = np.frombuffer(data, "<f4", buckets * bucket_bytes // 4, buckets_at).reshape(buckets, -1)[:, :3]
        owner = np.concatenate([np.repeat(np.arange(full), per_bucket), np.repeat(full + np.arange(partial), sizes)])
        if len(owner) < count or not span or owner.max(initial=0) >= buckets:
            raise malformed("the .ksplat file has Gaussians outside its buckets")
        means = (means - span) * (block / 2 / span) + middles[owner[:count]]
    with np.errstate(all="ignore"):
        scales = np.log(rows["scale"].astype(np.float32))
    harmonics = _of_colors(rows["color"][:, :3])
    if extra:
        rest = rows["rest"].astype(np.float32)
        if _SPANS[level] == 1:
            rest = levels[0] + rest / np.float32(255.0) * (levels[1] - levels[0])
        harmonics = np.concatenate([harmonics, _by_term(rest)], axis=1)
    opacities = _shares(rows["color"][:, 3])
    return Splats(means, scales, rows["turn"].astype(np.float32), opacities, harmonics), end


def _row_of(level: int, terms: int) -> tuple[int, np.dtype[Any]]:
    """How many coefficients beyond the color a row has, and the row."""
    place, number = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    extra = 3 * terms
    fields: list[Any] = [("place", place, 3), ("scale", number, 3), ("turn", number, 4), ("color", "u1", 4)]
    if extra:
        fields.append(("rest", "u1" if _SPANS[level] == 1 else number, extra))
    return extra, np.dtype(fields)


def _by_term(rest: Floats) -> Floats:
    """(N, K, 3), from the coefficients of each degree channel by channel: three of R, G, B each, then five of each."""
    parts = [rest[:, :9].reshape(-1, 3, 3)]
    if rest.shape[1] > 9:
        parts.append(rest[:, 9:24].reshape(-1, 3, 5))
    return np.concatenate([part.transpose(0, 2, 1) for part in parts], axis=1)


# .spz: columns of quantized numbers, packed by gzip (to version 3) or one by one by Zstandard (4).

_NGSP = b"NGSP"
_SPZ_HEADER, _SPZ4_HEADER = 16, 32
_COLOR = 0.15
"""A color's byte is 255 (0.5 + 0.15 x its coefficient)."""


def read_spz(data: memoryview) -> Splats:
    """Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED."""
    if bytes(data[:4]) == _NGSP:
        head, columns = _unpacked_streams(data)
    else:
        head, columns = _unpacked_gzip(data)
    version, count, degree, bits = head
    places, opacities, colors, scales, turns, rest = columns
    if version == 1:
        means = np.frombuffer(places, "<f2").reshape(count, 3).astype(np.float64)
    else:
        parts = np.frombuffer(places, np.uint8).reshape(count, 3, 3).astype(np.int32)
        whole = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
        means = (whole - ((whole & 0x800000) << 1)) / float(1 << bits)
    levels = np.frombuffer(colors, np.uint8).reshape(count, 3)
    harmonics = ((levels / 255.0 - 0.5) / _COLOR)[:, None].astype(np.float32)
    if degree:
        terms = _TERMS[degree] - 1
        coefficients = (np.frombuffer(rest, np.uint8).reshape(count, terms, 3).astype(np.float32) - 128.0) / 128.0
        harmonics = np.concatenate([harmonics, coefficients[:, : _MOST_TERMS - 1]], axis=1)
    return Splats(
        means,
        (np.frombuffer(scales, np.uint8).reshape(count, 3) / 16.0 - 10.0).astype(np.float32),
        _three_bytes(turns, count) if version < 3 else _four_bytes(turns),
        _shares(np.frombuffer(opacities, np.uint8)),
        harmonics,
    )


def _three_bytes(turns: bytes | memoryview, count: int) -> Floats:
    xyz: Doubles = np.frombuffer(turns, np.uint8).reshape(count, 3) / 127.5 - 1.0
    return smallest_three(np.zeros(count, np.int64), xyz)


def _four_bytes(turns: bytes | memoryview) -> Floats:
    """The index of the largest in x y z w, then ten bits a component, the sign the highest of them."""
    words = np.frombuffer(turns, "<u4").astype(np.int64)
    largest = words >> 30
    others = np.empty((len(words), 3))
    for place in range(3):
        part = words >> (20 - 10 * place) & 0x3FF
        others[:, place] = np.where(part & 0x200, -1.0, 1.0) * (part & 0x1FF) / 511.0 * np.sqrt(0.5)
    return np.roll(smallest_three(largest, others), 1, axis=1)  # stored as x y z w


def _sizes(version: int, count: int, degree: int) -> list[int]:
    each = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * (_TERMS[degree] - 1))
    return [count * size for size in each]


def _checked(data: bytes | memoryview) -> tuple[int, int, int, int]:
    """Version, count, degree of the harmonics, fractional bits of the places."""
    magic, version, count, degree, bits = struct.unpack_from("<4sIIBB", data)
    if magic != _NGSP or not 1 <= version <= 4:
        raise unsupported(f"an .spz file of version {version}; 1 to 4 are read")
    if degree >= len(_TERMS) or bits > 23:
        raise malformed("the .spz header is invalid")
    require_count(count)
    return version, count, degree, bits


def _unpacked_gzip(data: memoryview) -> tuple[tuple[int, int, int, int], list[memoryview]]:
    stream = zlib.decompressobj(31)
    try:
        start = stream.decompress(data, _SPZ_HEADER)
        if len(start) < _SPZ_HEADER:
            raise malformed("the .spz file ends within its header")
        head = _checked(start)
        sizes = _sizes(*head[:3])
        body = memoryview(stream.decompress(stream.unconsumed_tail, sum(sizes)))
    except zlib.error as error:
        raise malformed("the .spz file is damaged") from error
    if len(body) < sum(sizes):
        raise malformed("the .spz file ends within its Gaussians")
    ends = np.cumsum([0, *sizes])
    return head, [body[start:end] for start, end in pairwise(ends)]


def _unpacked_streams(data: memoryview) -> tuple[tuple[int, int, int, int], list[memoryview]]:
    if len(data) < _SPZ4_HEADER:
        raise malformed("the .spz file ends within its header")
    head = _checked(data)
    streams, (table,) = data[15], struct.unpack_from("<I", data, 16)
    sizes = _sizes(*head[:3])
    needed = len(sizes) if sizes[-1] else len(sizes) - 1
    at = table + 16 * streams
    if streams < needed or at > len(data):
        raise malformed("the .spz file has too few streams")
    found = []
    for number, size in enumerate(sizes[:needed]):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * number)
        if unpacked != size or at + packed > len(data):
            raise malformed("a stream of the .spz file has another size than its header says")
        found.append(_unzstd(data[at : at + packed], size))
        at += packed
    return head, [*found, *([memoryview(b"")] * (len(sizes) - needed))]


def _unzstd(packed: memoryview, size: int) -> memoryview:
    """Exactly ``size`` bytes."""
    try:
        from compression import zstd  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        from backports import zstd
    try:
        made: bytes = zstd.ZstdDecompressor().decompress(packed, size)
    except (zstd.ZstdError, EOFError) as error:
        raise malformed("a stream of the .spz file is damaged") from error
    if len(made) != size:
        raise malformed("a stream of the .spz file ends early")
    return memoryview(made)
