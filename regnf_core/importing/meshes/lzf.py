"""LZF, the compression of PCD files, by its published layout: literals, and copies of what was unpacked before."""

from __future__ import annotations

from regnf_core.importing.meshes.geometry import malformed

_LITERALS, _LONG = 32, 7


def unpack_lzf(packed: memoryview, size: int) -> memoryview:
    """The ``size`` bytes that ``packed`` holds; never more are made. Raises FieldFormatError (MESH_INVALID)."""
    if size > 264 * len(packed):  # a copy of three bytes makes 264 at most
        raise _faulty()
    source, made = bytes(packed), bytearray()
    at = 0
    try:
        while at < len(source):
            control = source[at]
            at += 1
            if control < _LITERALS:
                made += source[at : at + control + 1]
                at += control + 1
                if at > len(source):
                    raise _faulty()
            else:
                length = control >> 5
                if length == _LONG:
                    length += source[at]
                    at += 1
                back = ((control & 31) << 8 | source[at]) + 1
                at += 1
                _copy(made, back, length + 2)
            if len(made) > size:
                raise _faulty()
    except IndexError as error:
        raise _faulty() from error
    if len(made) != size:
        raise _faulty()
    return memoryview(bytes(made))


def _copy(made: bytearray, back: int, length: int) -> None:
    """Append ``length`` bytes from so far back; they may reach into what is appended."""
    start = len(made) - back
    if start < 0:
        raise _faulty()
    piece = bytes(made[start : start + length])
    made += (piece * (length // len(piece) + 1))[:length]


def _faulty() -> Exception:
    return malformed("the PCD file's compressed points do not unpack to the size that it says")
