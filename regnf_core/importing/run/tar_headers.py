"""The headers of a tar file, decoded and checked: what a member is called, what it is, how long it is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from regnf_core.importing.run.byte_stream import ByteStream
from regnf_core.importing.run.unpacking import MAX_NAME_BYTES, MAX_PARTS, archive_error

BLOCK = 512
_MAX_MEMBERS = 16_384
_MAX_RECORDS = 64 * 1024
_MAX_TAIL = 1 << 20
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")
_MAX_NUMBER = 1 << 60
_FILE, _FOLDER, _LINKS = b"0\0", b"5", b"12"
_LONG_NAME, _LONG_LINK, _RECORDS, _SHARED_RECORDS = b"L", b"K", b"x", b"g"
_OLD_TORCH = frozenset({"sys_info", "pickle", "storages", "tensors"})


@dataclass(frozen=True)
class TarMember:
    """One plain file of a tar file."""

    name: str
    size: int


def tar_members(stream: ByteStream) -> Iterator[TarMember]:
    """The files of a tar file in order, folders left out. The caller reads each one's content, ``size`` bytes, from the
    stream before it goes on, and calls :func:`end_of` behind it.

    Raises FieldFormatError: FILE_TRUNCATED, LEGACY_TORCH_FILE and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    seen: set[str] = set()
    for _ in range(_MAX_MEMBERS):
        found = _next_member(stream)
        if found is None:
            return
        name, is_folder, size = found
        if is_folder:
            continue
        if name in _OLD_TORCH:
            message = "a tar archive, as PyTorch wrote before version 0.1.10; save it again"
            raise archive_error(message, "LEGACY_TORCH_FILE")
        if name in seen:
            raise archive_error("two members share a name", "ARCHIVE_DUPLICATE_ENTRY")
        seen.add(name)
        yield TarMember(name, size)
    raise archive_error(f"more than {_MAX_MEMBERS} members", "ARCHIVE_TOO_MANY_ENTRIES")


def padding_of(size: int) -> int:
    """How many bytes lie between a member's content and the next header."""
    return -size % BLOCK


def _next_member(stream: ByteStream) -> tuple[str, bool, int] | None:
    """Name, whether it is a folder, and size of the next member, after the headers that only say more about it."""
    said: dict[str, str] = {}
    for _ in range(4):
        header = _bytes(stream, BLOCK)
        if not any(header):
            _require_end(stream)
            return None
        _check_sum(header)
        kind, size = header[156:157], _number(header[124:136])
        if kind in (_LONG_NAME, _RECORDS, _SHARED_RECORDS, _LONG_LINK):
            if size > _MAX_RECORDS:
                raise archive_error("a header says too much", "ARCHIVE_ENTRY_NAME")
            content = _bytes(stream, size)
            _bytes(stream, padding_of(size))
            said |= _records(content, kind)
            continue
        _require_plain(kind, said)
        name, size = said.get("path", _stored_name(header)), int(said.get("size", size))
        is_folder = kind == _FOLDER or (kind == b"\0" and name.endswith("/"))
        if is_folder and size:
            raise archive_error("a folder with a content")
        name = _checked_name(name)
        if name == "." and not is_folder:
            raise archive_error("a member without a name", "ARCHIVE_ENTRY_NAME")
        return name, is_folder, size
    raise archive_error("too many headers for one member")


def _require_plain(kind: bytes, said: dict[str, str]) -> None:
    if kind in (b"1", b"2"):
        message = "the archive holds a link; pack the run with what it leads to (tar --dereference)"
        raise archive_error(message, "ARCHIVE_LINK")
    if kind not in (b"0", b"\0", _FOLDER):
        raise archive_error(
            "the archive holds a device, a sparse file or something else than plain files", "ARCHIVE_SPECIAL_FILE"
        )
    if any(key.startswith("GNU.sparse") for key in said):
        raise archive_error("the archive holds a sparse file; pack it without --sparse", "ARCHIVE_SPECIAL_FILE")


def _records(content: bytes, kind: bytes) -> dict[str, str]:
    """What a header about the next member says of its name and size."""
    if kind == _LONG_LINK:
        return {}
    if kind == _LONG_NAME:
        return {"path": _text(content.rstrip(b"\0"))}
    found: dict[str, str] = {}
    at = 0
    while at < len(content):
        length, space, _ = content[at : at + 8].partition(b" ")
        end = at + int(length) if space and length.isdigit() else 0
        if not at + len(length) + 1 < end <= len(content) or content[end - 1 : end] != b"\n":
            raise archive_error("a header's records are malformed")
        key, equals, value = content[at + len(length) + 1 : end - 1].partition(b"=")
        if not equals:
            raise archive_error("a header's records are malformed")
        name = key.decode("latin-1")
        if name in ("path", "size") or name.startswith("GNU.sparse"):
            found[name] = _text(value)
        at = end
    if "size" in found and not (found["size"].isdigit() and len(found["size"]) < 19):
        raise archive_error("a member's size is no number")
    if kind == _SHARED_RECORDS:
        if found:
            raise archive_error("a header for all members names one")
        return {}
    return found


def _checked_name(name: str) -> str:
    """The name below the archive's folder. Raises FieldFormatError (ARCHIVE_ENTRY_NAME)."""
    name = name.removesuffix("/")
    while name.startswith("./"):
        name = name[2:]
    if name in (".", ""):
        return "."
    parts = name.split("/")
    if len(name.encode()) > MAX_NAME_BYTES or len(parts) > MAX_PARTS:
        raise archive_error("a member's name is too long", "ARCHIVE_ENTRY_NAME")
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
        raise archive_error("a member's name leaves the archive's folder or is not a valid name", "ARCHIVE_ENTRY_NAME")
    return name


def _stored_name(header: bytes) -> str:
    name = _text(header[:100].split(b"\0")[0])
    prefix = _text(header[345:500].split(b"\0")[0]) if header[257:263] == b"ustar\0" else ""
    return f"{prefix}/{name}" if prefix else name


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise archive_error("a member's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error


def _number(field: bytes) -> int:
    """Octal digits, or a big-endian number behind the byte 0x80."""
    if field[0] == 0x80:
        value = int.from_bytes(field[1:], "big")
    else:
        digits = field.strip(b" \0")
        if digits and (len(digits) > 11 or digits.strip(b"01234567")):
            raise archive_error("a header's number is malformed")
        value = int(digits or b"0", 8)
    if value > _MAX_NUMBER:
        raise archive_error("a member claims more bytes than any file has", "ARCHIVE_TOO_LARGE")
    return value


def _check_sum(header: bytes) -> None:
    if sum(header[:148]) + 8 * 32 + sum(header[156:]) != _number(header[148:156]):
        raise archive_error("a header's sum is wrong")


def _require_end(stream: ByteStream) -> None:
    """Behind the first empty block comes at least one more, and nothing else."""
    tail = 0
    for piece in stream.rest():
        tail += len(piece)
        if tail > _MAX_TAIL or any(piece):
            raise archive_error("something lies behind the archive's end", "ARCHIVE_TRAILING_DATA")


def _bytes(stream: ByteStream, size: int) -> bytes:
    return b"".join(stream.pieces(size))
