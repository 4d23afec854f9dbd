"""Archives and other containers that no trainer wrote, each with what becomes of it."""

from __future__ import annotations

import io
import json
import tarfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from random import Random

import numpy as np
import torch

from tests.core.importing.archives import patched, torch_zip
from tests.core.importing.fuzzing.archive_model import Ending, Record, archive_bytes
from tests.core.importing.fuzzing.byte_mutations import little
from tests.core.importing.fuzzing.seeds import Seeds

Build = Callable[[Seeds], bytes]
Files = dict[str, tuple[Build, str]]
"""Row of bad-inputs.md: how the file is made, and its outcome."""

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + bytes(600)


def record(seeds: Seeds, name: str, **changes: object) -> list[Record]:
    """The sound archive's records, one of them changed."""
    full = f"archive/{name}".encode()
    return [replace(r, **changes) if r.name == full else r for r in seeds.records]  # type: ignore[arg-type]


def weight_entry(seeds: Seeds) -> str:
    """The entry of a weight that the field needs."""
    return next(f"data/{key}" for name, key, _ in seeds.tensors if name.endswith("glin1.weight_v"))


def damaged_crc(seeds: Seeds) -> bytes:
    data = next(r.data for r in seeds.records if r.name.endswith(weight_entry(seeds).encode()))
    at = seeds.archive.index(data) + 5
    return patched(seeds.archive, at, bytes([seeds.archive[at] ^ 1]))


def legacy_tar(_: Seeds) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for name in ("sys_info", "pickle", "tensors"):
            archive.addfile(tarfile.TarInfo(name))
    return buffer.getvalue()


def legacy_checkpoint(call: bytes) -> bytes:
    """A file of before PyTorch 1.6 whose object is what the opcodes make."""
    buffer = io.BytesIO()
    torch.save({}, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue().replace(b"\x80\x02}q\x00.", b"\x80\x02" + call + b".")


def deflate_bomb(seeds: Seeds) -> bytes:
    """64 MiB of zeros in 64 KiB, under the name of a weight."""
    zeros = bytes(64 << 20)
    packer = zlib.compressobj(1, wbits=-15)
    packed = packer.compress(zeros) + packer.flush()
    claims = {"method": 8, "size": len(zeros), "crc": zlib.crc32(zeros)}
    return archive_bytes(record(seeds, weight_entry(seeds), data=packed, local=claims, central=claims))


def arrays(**values: object) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **values)  # type: ignore[arg-type]
    return buffer.getvalue()


def npz_bomb(_: Seeds) -> bytes:
    """A dense grid of zeros, true to its size: 84 MB in 80 kB."""
    return arrays(sdf=np.zeros((256, 256, 320), np.float32), bounds=np.array([[-1.0] * 3, [1.0] * 3]))


def npz_that_lies(_: Seeds) -> bytes:
    """A megabyte of zeros that claims to be a hundred bytes."""
    packer = zlib.compressobj(wbits=-15)
    packed = packer.compress(bytes(1 << 20)) + packer.flush()
    claims = {"method": 8, "size": 100}
    return archive_bytes([Record(b"sdf.npy", packed, local=claims, central=claims)])


def npz_of_objects(_: Seeds) -> bytes:
    return arrays(sdf=np.array([[[print]]], dtype=object), bounds=np.array([[-1.0] * 3, [1.0] * 3]))


def overlap(seeds: Seeds) -> bytes:
    """The directory sends two names to one entry."""
    records = [Record(b"archive/data.pkl", b"\x80\x02}."), Record(b"archive/a", b"aa")]
    return archive_bytes([*records, Record(b"archive/b", b"bb", central={"offset": 0})])


def a_million_entries(_: Seeds) -> bytes:
    """Really there, in 88 MB; with the wide directory record that so many need."""
    one = archive_bytes([Record(b"a/data", b"")])
    local, central = one[:36], one[36:88]
    count = 1_000_000
    ending = archive_bytes([], Ending(wide=True))
    wide = little(count, 8) * 2 + little(len(central) * count, 8) + little(len(local) * count, 8)
    narrow = little(0xFFFF, 2) * 2 + little(0xFFFFFFFF, 4) * 2
    ending = ending[:24] + wide + ending[56:64] + little(88 * count, 8) + ending[72:84] + narrow + ending[-2:]
    return local * count + central * count + ending


def header_of(file: bytes, change: Callable[[dict[str, dict[str, object]]], object]) -> bytes:
    """The field file with its header changed."""
    length = int.from_bytes(file[:8], "little")
    header = json.loads(file[8 : 8 + length])
    change(header)
    text = json.dumps(header).encode()
    return little(len(text), 8) + text + file[8 + length :]


def duplicate_key(seeds: Seeds) -> bytes:
    length = int.from_bytes(seeds.field_file[:8], "little")
    text = seeds.field_file[8 : 8 + length].rstrip()[:-1] + b',"__metadata__":{}}'
    return little(len(text), 8) + text + seeds.field_file[8 + length :]


def many_tensors(count: int) -> bytes:
    entry = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
    text = json.dumps({f"t{i}": entry for i in range(count)}).encode()
    return little(len(text), 8) + text


def moved(by: int) -> Callable[[dict[str, dict[str, object]]], object]:
    """Let one tensor begin elsewhere, as long as before."""

    def change(header: dict[str, dict[str, object]]) -> None:
        begin, end = header["layers.1.bias"]["data_offsets"]  # type: ignore[misc]
        header["layers.1.bias"]["data_offsets"] = [begin + by, end + by]

    return change


def wrong_size(seeds: Seeds) -> bytes:
    sizes = dict.fromkeys(("size", "packed"), 0xFFFFFFFF)
    extra = little(1, 2) + little(16, 2) + little(1 << 63, 8) * 2
    return archive_bytes(record(seeds, "version", central=sizes, central_extra=extra))


CONTAINERS: Files = {
    "random bytes": (lambda _: Random(3).randbytes(5000), "415 FIELD_NOT_RECOGNIZED"),
    "a renamed PNG": (lambda _: PNG, "415 FIELD_NOT_RECOGNIZED"),
    "truncated": (lambda s: s.archive[: len(s.archive) // 2], "rejected FILE_TRUNCATED"),
    "truncated by one byte": (lambda s: s.archive[:-1], "rejected FILE_TRUNCATED"),
    "a truncated field file": (lambda s: s.field_file[:-1], "rejected FILE_TRUNCATED"),
    "CRC flipped": (damaged_crc, "rejected ARCHIVE_CRC_MISMATCH"),
    "legacy tar": (legacy_tar, "415 FIELD_NOT_RECOGNIZED"),
    "a bare pickle": (lambda s: s.pickles[2], "415 FIELD_NOT_RECOGNIZED"),
    "a legacy file that calls": (lambda _: legacy_checkpoint(b"cos\nsystem\n)R"), "rejected UNSAFE_GLOBAL_IN_WEIGHTS"),
    "TorchScript": (
        lambda s: archive_bytes([*s.records, Record(b"archive/constants.pkl", b"\x80\x02).")]),
        "rejected ARCHIVE_TORCHSCRIPT",
    ),
    "7z": (lambda _: b"7z\xbc\xaf\x27\x1c" + bytes(600), "415 FIELD_NOT_RECOGNIZED"),
    "a zip for a pickle": (lambda s: s.with_pickle(s.archive), "rejected PICKLE_PROTOCOL"),
    "deflate bomb": (deflate_bomb, "rejected ARCHIVE_COMPRESSED_ENTRY"),
    "deflate bomb in an npz": (npz_bomb, "rejected TENSOR_TOO_LARGE"),
    "an npz that inflates to more than it claims": (npz_that_lies, "rejected ARCHIVE_DEFLATE_MALFORMED"),
    "pickled objects in an npz": (npz_of_objects, "rejected NPY_OBJECT_ARRAY"),
    "overlapping entries": (overlap, "rejected ARCHIVE_OVERLAP"),
    "a million entries": (a_million_entries, "rejected ARCHIVE_TOO_MANY_ENTRIES"),
    "duplicate data.pkl": (
        lambda s: archive_bytes([*s.records, Record(b"archive/data.pkl", b"\x80\x02}.")]),
        "rejected ARCHIVE_DUPLICATE_ENTRY",
    ),
    "header mismatch": (
        lambda s: archive_bytes(record(s, "data.pkl", local={"size": 5, "packed": 5})),
        "rejected ARCHIVE_HEADER_MISMATCH",
    ),
    "a ../ entry": (
        lambda s: archive_bytes([*s.records, Record(b"archive/../../x", b"")]),
        "rejected ARCHIVE_ENTRY_NAME",
    ),
    "encrypted": (
        lambda s: archive_bytes(record(s, "data.pkl", local={"flags": 1}, central={"flags": 1})),
        "rejected ARCHIVE_ENCRYPTED",
    ),
    "zip64 sizes of 2^63": (wrong_size, "rejected ARCHIVE_ENTRY_OUT_OF_BOUNDS"),
    "PNG before an archive": (lambda s: PNG + s.archive, "415 FIELD_NOT_RECOGNIZED"),
    "pickle before an archive": (lambda s: s.pickles[2] + s.archive, "415 FIELD_NOT_RECOGNIZED"),
    "field file before an archive": (lambda s: s.field_file + s.archive, "rejected SAFETENSORS_LAYOUT"),
    "field file behind an archive": (lambda s: s.archive + s.field_file[: 1 << 15], "rejected ARCHIVE_TRAILING_DATA"),
    "archive in an archive's gap": (
        lambda s: archive_bytes(record(s, "version", gap=torch_zip())),
        "rejected ARCHIVE_HIDDEN_DATA",
    ),
    "big-endian": (lambda s: archive_bytes(record(s, "byteorder", data=b"big")), "rejected ARCHIVE_BYTE_ORDER"),
    "safetensors header of 2^63": (
        lambda s: little(1 << 63, 8) + s.field_file[8:],
        "rejected SAFETENSORS_HEADER_TOO_LARGE",
    ),
    "safetensors header of 100 MB": (
        lambda _: little(100 << 20, 8) + b"{" + b" " * (100 << 20),
        "rejected SAFETENSORS_HEADER_TOO_LARGE",
    ),
    "safetensors, bad JSON": (
        lambda s: s.field_file[:9] + b"?" + s.field_file[10:],
        "rejected SAFETENSORS_HEADER_MALFORMED",
    ),
    "safetensors, duplicate keys": (duplicate_key, "rejected SAFETENSORS_DUPLICATE_KEY"),
    "safetensors, overlap": (lambda s: header_of(s.field_file, moved(-4)), "rejected SAFETENSORS_LAYOUT"),
    "safetensors, hole": (lambda s: header_of(s.field_file, moved(4)), "rejected SAFETENSORS_LAYOUT"),
    "safetensors, past the end": (lambda s: header_of(s.field_file, moved(1 << 40)), "rejected SAFETENSORS_LAYOUT"),
    "safetensors, 10^5 tensors": (lambda _: many_tensors(100_000), "rejected SAFETENSORS_HEADER_TOO_LARGE"),
    "safetensors, 2000 tensors": (lambda _: many_tensors(2000), "rejected SAFETENSORS_TOO_MANY_TENSORS"),
}
