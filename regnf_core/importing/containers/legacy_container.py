"""The container that torch.save wrote before version 1.6, and still writes on request: pickles, then raw storages.

In order: a magic number, the protocol's version, facts about the machine, the values, the storages' keys (five
pickles), then each storage: its count of elements in eight bytes, and the elements. Read by the same reader that never
imports. There are no checksums; but every byte must be accounted for, so the file has one reading only.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.zip_members import DEFLATED, MAX_ENTRIES, STORED, Member, malformed, read_members
from regnf_core.importing.pickle.pickle_machine import PickleLimits, StorageRef
from regnf_core.importing.pickle.pickle_reader import read_leading_pickle

# The zip container of torch.save, checked against its own rules instead of a lenient reader's.
#
# torch.save stores every entry uncompressed and leaves no byte unaccounted for, so there is nothing to inflate, and
# every entry can be mapped where it lies.

MAX_PICKLE_BYTES = 32 * 1024 * 1024


@dataclass(frozen=True)
class TorchArchive:
    """The entries by their name below the archive's folder: "data.pkl", "data/0" ... Those of the older container are
    its storages, by the names that they have in a zip.
    """

    data: memoryview
    entries: Mapping[str, Member]

    def read(self, name: str) -> memoryview:
        """The entry's bytes, not copied, their CRC checked. Raises FieldFormatError (ARCHIVE_CRC_MISMATCH)."""
        return self.entries[name].content(self.data)


def read_archive(
    data: memoryview, max_pickle_bytes: int = MAX_PICKLE_BYTES, members: list[Member] | None = None
) -> TorchArchive:
    """Check the container's structure and list its entries. ``data`` is the whole file, usually a memory map.

    members: what ``read_members`` listed, compressed entries and folders too, where the file was read already.
    Raises FieldFormatError: FILE_TRUNCATED, PICKLE_TOO_LARGE and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    listed = members or []
    if not listed or any(member.method != STORED or member.name.endswith("/") for member in listed):
        listed = _strictly_listed(data)
    _refuse_programs(listed)
    entries = _below_one_folder(listed)
    if sum(name.rsplit("/", 1)[-1] == "data.pkl" for name in entries) > 1:
        raise malformed("more than one data.pkl", "ARCHIVE_DUPLICATE_ENTRY")
    if "data.pkl" not in entries:
        raise malformed("the archive has no data.pkl: torch.save did not write it", "ARCHIVE_NO_PICKLE")
    if entries["data.pkl"].size > max_pickle_bytes:
        raise malformed(f"data.pkl is larger than {max_pickle_bytes} bytes", "PICKLE_TOO_LARGE")
    archive = TorchArchive(data, entries)
    if "byteorder" in entries and bytes(archive.read("byteorder")[:16]) != b"little":
        raise malformed("the tensors are not little-endian", "ARCHIVE_BYTE_ORDER")
    return archive


def _strictly_listed(data: memoryview) -> list[Member]:
    try:
        return read_members(data)
    except FieldFormatError as error:
        if error.reason == "ARCHIVE_COMPRESSED_ENTRY":
            inflatable: list[Member] = []
            with suppress(FieldFormatError):
                inflatable = read_members(data, (STORED, DEFLATED))
            _refuse_programs(inflatable)
        raise


def _refuse_programs(members: list[Member]) -> None:
    inner = [member.name.partition("/")[2] for member in members]
    if any(name == "constants.pkl" or name.startswith("code/") for name in inner):
        message = "a TorchScript archive holds a program, not weights: save state_dict() of it, or export it as ONNX"
        raise malformed(message, "ARCHIVE_TORCHSCRIPT")


def _below_one_folder(members: list[Member]) -> dict[str, Member]:
    """Entries by their name below the one folder all of them share."""
    parts = [(member.name.partition("/"), member) for member in members]
    if not all(name for (_, _, name), _ in parts):
        raise malformed("an entry is not in a folder", "ARCHIVE_ENTRY_NAME")
    if len({folder for (folder, _, _), _ in parts}) != 1:
        raise malformed("the entries are in several folders", "ARCHIVE_ENTRY_NAME")
    return {name: member for (_, _, name), member in parts}


_MAGIC = 0x1950A86A20F9469CFC6C
_PROTOCOL = 1001
_SMALL = PickleLimits(opcodes=1000, stack=100, marks=10, memo=100)
_KEYS = PickleLimits(opcodes=4 * MAX_ENTRIES, stack=2 * MAX_ENTRIES, marks=10, memo=2 * MAX_ENTRIES)
_COUNT_BYTES = 8
_ELEMENT_BYTES = {"float32": 4, "float64": 8, "float16": 2, "bfloat16": 2}
_ELEMENT_BYTES |= {"int64": 8, "int32": 4, "int16": 2, "int8": 1, "uint8": 1, "bool": 1}


def read_legacy(data: memoryview) -> tuple[Any, TorchArchive]:
    """The values that were saved, and the storages of their tensors. ``data`` is the whole file.

    Raises FieldFormatError: FILE_TRUNCATED, LEGACY_MALFORMED, ARCHIVE_BYTE_ORDER, ARCHIVE_TOO_MANY_ENTRIES,
    ARCHIVE_TRAILING_DATA, TENSOR_DTYPE, TENSOR_STORAGE_MISSING, TENSOR_STORAGE_MISMATCH and the PICKLE_* reasons.
    """
    magic, at, _ = _leading(data, 0, _SMALL)
    protocol, at, _ = _leading(data, at, _SMALL)
    machine, at, _ = _leading(data, at, _SMALL)
    if magic != _MAGIC or protocol != _PROTOCOL or not isinstance(machine, dict):
        raise _malformed("the beginning of the file was not written by torch.save")
    if machine.get("little_endian") is not True:
        raise FieldFormatError("the tensors are not little-endian", reason="ARCHIVE_BYTE_ORDER")
    values, at, storages = _leading(data, at, PickleLimits())
    keys, at, _ = _leading(data, at, _KEYS)
    return values, TorchArchive(data, _entries(data, at, _checked_keys(keys), storages))


def _leading(data: memoryview, at: int, limits: PickleLimits) -> tuple[Any, int, dict[str, StorageRef]]:
    """The value of the pickle at ``at``, where it ends, and the storages it names."""
    if at >= len(data):
        raise FieldFormatError("the file is truncated", reason="FILE_TRUNCATED")
    value, length, storages = read_leading_pickle(data[at : at + MAX_PICKLE_BYTES], limits)
    return value, at + length, storages


def _checked_keys(keys: object) -> list[str]:
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys) or len(set(keys)) != len(keys):
        raise _malformed("the storages' keys are not a list of names")
    if len(keys) > MAX_ENTRIES:
        message = f"{len(keys)} storages; at most {MAX_ENTRIES} are read"
        raise FieldFormatError(message, reason="ARCHIVE_TOO_MANY_ENTRIES")
    return keys


def _entries(data: memoryview, at: int, keys: list[str], storages: Mapping[str, StorageRef]) -> dict[str, Member]:
    """Where each storage lies, one behind the other from ``at`` to the end of the file."""
    entries = {}
    for key in keys:
        storage = storages.get(key)
        if storage is None:
            raise FieldFormatError("a storage that no tensor uses", reason="TENSOR_STORAGE_MISSING")
        element = _ELEMENT_BYTES.get(storage.dtype or "")
        if element is None:
            raise FieldFormatError(f"a storage of {storage.type_name}, of unknown size", reason="TENSOR_DTYPE")
        size = storage.count * element
        if at + _COUNT_BYTES + size > len(data):
            raise FieldFormatError("the file is truncated", reason="FILE_TRUNCATED")
        count = int.from_bytes(data[at : at + _COUNT_BYTES], "little")
        if count != storage.count:
            message = f"a storage of {storage.count} elements has {count} in the file"
            raise FieldFormatError(message, reason="TENSOR_STORAGE_MISMATCH")
        at += _COUNT_BYTES
        entries[f"data/{key}"] = Member(f"data/{key}", STORED, at, size, size, crc32=None)
        at += size
    if at != len(data):
        raise FieldFormatError("the file has data after the last storage", reason="ARCHIVE_TRAILING_DATA")
    return entries


def _malformed(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="LEGACY_MALFORMED")
