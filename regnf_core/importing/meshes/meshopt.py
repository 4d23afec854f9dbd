"""Buffers compressed by meshoptimizer, as glTF has them: the decoder of the bitstreams that the extension
EXT_meshopt_compression specifies (attributes of version 0, triangles of version 1, sequences of version 1) and of its
filters.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.triangle_files import malformed, unsupported

Bytes = npt.NDArray[np.uint8]
_ATTRIBUTES, _TRIANGLES, _SEQUENCE = 0xA0, 0xE1, 0xD1
"""The first byte of each bitstream: its kind and version."""
_BLOCK_BYTES, _BLOCK_ITEMS, _GROUP, _TAIL = 8192, 256, 16, 32
_TWO_BITS = [sum((byte >> shift & 3) == 3 for shift in (0, 2, 4, 6)) for byte in range(256)]
_FOUR_BITS = [(byte >> 4 == 15) + (byte & 15 == 15) for byte in range(256)]
"""How many of the differences in a byte are too large for so few bits: each is in a byte of its own behind them."""
_FAULTY = "compressed data of a glTF buffer view is damaged"


def decoded(data: memoryview, count: int, stride: int, mode: str, filter_: str) -> memoryview:
    """The ``count`` items of ``stride`` bytes each. Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED."""
    try:
        if mode == "ATTRIBUTES":
            with np.errstate(all="ignore"):  # what is damaged may be no number
                items: npt.NDArray[Any] = _filtered(_attributes(bytes(data), count, stride), filter_)
        elif mode in ("TRIANGLES", "INDICES") and stride in (2, 4) and filter_ == "NONE":
            order = _triangles(bytes(data), count) if mode == "TRIANGLES" else _sequence(bytes(data), count)
            items = np.array(order, np.int64).astype("<u2" if stride == 2 else "<u4")
        else:
            raise malformed(f"a glTF buffer view with the compression {mode[:20]}, {filter_[:20]}")
    except (IndexError, ValueError) as error:
        raise malformed(_FAULTY) from error
    return memoryview(items.tobytes())


def _require(sound: bool) -> None:
    if not sound:
        raise malformed(_FAULTY)


def _require_version(data: bytes, header: int) -> None:
    if data[0] & 0xF0 == header & 0xF0 and data[0] != header:
        raise unsupported("a glTF file with meshopt compression of another version; use EXT_meshopt_compression")
    _require(data[0] == header)


def _attributes(data: bytes, count: int, stride: int) -> Bytes:
    """(count, stride) bytes: for each block and each byte of an item, differences in groups of 16."""
    _require_version(data, _ATTRIBUTES)
    _require(0 < stride <= 256 and stride % 4 == 0 and len(data) > max(stride, _TAIL))
    raw = np.frombuffer(data, np.uint8)
    items, last, at = np.empty((count, stride), np.uint8), raw[len(raw) - stride :].copy(), 1
    block = min(_BLOCK_BYTES // stride & ~(_GROUP - 1), _BLOCK_ITEMS)
    for start in range(0, count, block):
        size = min(block, count - start)
        groups = -(-size // _GROUP)
        deltas = np.zeros((groups * _GROUP, stride), np.uint8)
        for column in range(stride):
            at = _column(data, raw, at, groups, deltas[:, column])
        signed = (deltas >> 1) ^ -(deltas & 1)
        signed[0] += last
        items[start : start + size] = np.cumsum(signed[:size], axis=0, dtype=np.uint8)
        last = items[start + size - 1]
    _require(len(data) - at == max(stride, _TAIL))
    return items


def _column(data: bytes, raw: Bytes, at: int, groups: int, deltas: Bytes) -> int:
    """Fill ``deltas`` from the groups that begin at ``at``. Returns where they end."""
    header, at = at, at + -(-groups // 4)
    for group in range(groups):
        kind = data[header + group // 4] >> 2 * (group % 4) & 3
        if kind == 0:
            continue
        out = deltas[_GROUP * group : _GROUP * (group + 1)]
        if kind == 3:
            out[:] = raw[at : at + _GROUP]
            at += _GROUP
            continue
        packed = raw[at : at + 4 * kind, None]
        shifts, largest = (np.array([6, 4, 2, 0], np.uint8), 3) if kind == 1 else (np.array([4, 0], np.uint8), 15)
        out[:] = (packed >> shifts & largest).reshape(-1)
        table = _TWO_BITS if kind == 1 else _FOUR_BITS
        large = sum(table[byte] for byte in data[at : at + 4 * kind])
        at += 4 * kind
        if large:
            out[out == largest] = raw[at : at + large]
            at += large
    return at


def _filtered(items: Bytes, filter_: str) -> npt.NDArray[Any]:
    """What the items (N, stride) stand for."""
    stride = items.shape[1]
    if filter_ == "NONE":
        return items
    if filter_ == "EXPONENTIAL":
        words = items.view("<i4").astype(np.int64)
        numbers: npt.NDArray[Any] = np.ldexp(((words & 0xFFFFFF) ^ 0x800000) - 0x800000, words >> 24).astype("<f4")
        return numbers
    if filter_ == "OCTAHEDRAL" and stride in (4, 8):
        whole = items.view("i1" if stride == 4 else "<i2")
        x, y, one = (whole[:, axis].astype(np.float64) for axis in range(3))
        z = one - np.abs(x) - np.abs(y)
        fold = np.minimum(z, 0.0)
        normal = np.stack((x - np.copysign(fold, x), y - np.copysign(fold, y), z), axis=1)
        normal *= np.iinfo(whole.dtype).max / np.linalg.norm(normal, axis=1, keepdims=True)
        return np.concatenate((np.rint(normal).astype(whole.dtype), whole[:, 3:]), axis=1)
    if filter_ == "QUATERNION" and stride == 8:
        words = items.view("<i2").astype(np.int64)
        three = words[:, :3] / (np.sqrt(2.0) * (words[:, 3:] | 3))
        largest = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(axis=1)))
        columns = (np.arange(4) - 1 - (words[:, 3:] & 3)) % 4
        turned = np.take_along_axis(np.concatenate((three, largest[:, None]), axis=1), columns, axis=1)
        return np.rint(turned * 32767.0).astype("<i2")
    raise malformed(f"a glTF buffer view with the filter {filter_[:20]}")


def _variable(data: bytes, at: int) -> tuple[int, int]:
    """A number in groups of 7 bits, the lowest first, and where it ends."""
    number = 0
    for shift in range(0, 35, 7):
        byte = data[at]
        at += 1
        number |= (byte & 127) << shift
        if byte < 128:
            return number, at
    raise malformed(_FAULTY)


def _sequence(data: bytes, count: int) -> list[int]:
    """Numbers by their differences to the last one of two lines of numbers."""
    _require_version(data, _SEQUENCE)
    order, last, at = [], [0, 0], 1
    for _ in range(count):
        number, at = _variable(data, at)
        line, number = number & 1, number >> 1
        last[line] = (last[line] + ((number >> 1) ^ -(number & 1))) & 0xFFFFFFFF
        order.append(last[line])
    _require(len(data) - at == 4)
    return order


def _triangles(data: bytes, count: int) -> list[int]:
    """Corners: a code for each triangle names an edge and a vertex of those that were last used, or new ones."""
    _require_version(data, _TRIANGLES)
    _require(count % 3 == 0 and len(data) > count // 3 + 16)
    codes, auxiliary, at = data[1 : 1 + count // 3], data[-16:], 1 + count // 3
    edges, recent = deque([(0, 0)] * 16, maxlen=16), deque([0] * 16, maxlen=16)  # the last ones come last
    order, next_, last = list[int](), 0, 0

    def free() -> int:
        nonlocal last, at
        number, at = _variable(data, at)
        last = (last + ((number >> 1) ^ -(number & 1))) & 0xFFFFFFFF
        return last

    for code in codes:
        if code < 0xF0:
            a, b = edges[-1 - (code >> 4)]
            third = code & 15
            if third == 0:
                c, next_ = next_, next_ + 1
            elif third < 13:
                c = recent[-1 - third]
            else:
                c = last = free() if third == 15 else last + (1 if third == 14 else -1)
            if third == 0 or third >= 13:
                recent.append(c)
        else:
            given = code >= 0xFE
            more = data[at] if given else auxiliary[code & 15]
            at += given
            if given and more == 0:
                next_ = 0
            corners = []
            kinds = (15 if code == 0xFF else 0, more >> 4, more & 15)
            for kind in kinds:
                if kind == 0:
                    corners.append(next_)
                    next_ += 1
                else:
                    corners.append(-1 if given and kind == 15 else recent[-kind])
            for place, kind in enumerate(kinds):
                if given and kind == 15:
                    corners[place] = free()
            a, b, c = corners
            recent.extend(corners[place] for place, kind in enumerate(kinds) if kind == 0 or (given and kind == 15))
            edges.append((b, a))
        edges.extend(((c, b), (a, c)))
        order += (a, b, c)
    _require(len(data) - at == 16)
    return order
