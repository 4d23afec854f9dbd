from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest

from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format
from tests.core.importing.archives import torch_zip, zip_bytes

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
LEGACY_TORCH = bytes.fromhex("80028a0a6cfc9c46f9206aa850192e80024de903")
LEGACY_TAR = b"sys_info".ljust(257, b"\0") + b"ustar\x0000"


FACET = struct.pack("<12fH", 0, 0, 1, *range(1, 10), 0)


def _license(sign: str) -> bytes:
    return (f"{sign} Permission is granted to whoever reads these words.\n" * 40).encode()


BOM = b"\xef\xbb\xbf"
HEADS: dict[str | None, list[bytes]] = {
    "obj": [
        b"# File exported by Houdini\n# 8 points\ng\nv 0 0 1\nv 0 1 1\n",
        *(_license("#") + b"v 0 0 1\n", _license("#") * 9, b"# exported by an OBJ writer of many words\n" * 20),
        BOM + b"# a mesh\r\n\r\nmaplib a\r\no\r\nv 0 0 1\r\n",
        *(b"# Blender v2.92\n# \xc3\xa9\nmtllib a.mtl\no Cube\n", b"\r\nv 1.0 -2e-3 .5\r\n"),
    ],
    "stl": [
        *(b"solid " + b"/" * 3000 + b"\nfacet normal 0 0 1\n", BOM + b" \n SOLID X\n FACET NORMAL 0 0 1\n"),
        *(b"solid\n" + b"facet normal 0 0 1\n", b"solid thing\n  facet normal 0 0 1\n"),
        b"solid, says the header".ljust(80) + struct.pack("<I", 900) + 20 * FACET,
    ],
    "ply": [BOM + b"ply \r\nformat ascii 1.0\r\n", b"ply\nformat binary_little_endian 1.0\n"],
    "xyz": [
        *(_license("//") + b"1 2 3\n4 5 6\n", b"1 2 3\n4e1 5 6\n", b"# x y z\n2\n1,2,3\n"),
        b"1.5 2.5 3.5 0.1 0.2 0.3\n" * 30,
        b"0,0,1\n;\n0;1;0\n,\n",  # a line of separators says nothing
    ],
    "pcd": [b"VERSION 0.7\nFIELDS x y z\n", b"# .PCD v.7\nFIELDS x\n"],
    "glb": [b"glTF\x02\0\0\0"],
    "gltf": [b'{"asset": {"version": "2.0"}, "buffers": []}'],
    "torch-zip": [torch_zip(), b"PK\x03\x04\x00"],  # the second is cut short
    "torch-legacy": [LEGACY_TORCH],
    "safetensors": [(64).to_bytes(8, "little") + b'{"a":'],
    "npz": [zip_bytes([("points.npy", b"\x93NUMPY")])],
    "sqlite": [b"SQLite format 3\x00".ljust(100, b"\x01")],
    "zip": [zip_bytes([("points.txt", b"1 2 3")])],
    "tar": [b"run/config.yml".ljust(257, b"\0") + b"ustar\x0000"],
    "gzip": [b"\x1f\x8b\x08\x00"],
    "bzip2": [b"BZh91AY&SY"],
    "xz": [b"\xfd7zXZ\x00\x00\x04"],
    None: [b"g\n", b"end of the story\nonce more\n", b"solid\x00\x01", _license("%")],
}


@pytest.mark.parametrize("format_", HEADS)
def test_the_first_bytes_and_statements_decide(format_: str | None) -> None:
    heads = HEADS[format_]
    assert [sniff_format(head[:HEAD_BYTES]) for head in heads] == [format_] * len(heads)


UNKNOWN = [
    *(b"x", PNG, b'{"frames": [], "camera_model": "OPENCV"}', b"<?xml version='1.0'?><svg/>", b"OFFICE hours"),
    *(b"VERSION 3\n", b"1 2\n3 4\n", b"1 2 3\n4 5\n", b";", b",;\n,\n", b"v is for vertex", b"x" * 512),
    *(b"# a list of things\nv 1 2 3\x00", b"7z\xbc\xaf\x27\x1c"),
    bytes(80) + b"\x08\0\0\0" + bytes(428),  # an STL file's facets have corners
]


@pytest.mark.parametrize(
    ("head", "reason", "words"),
    [
        *((head, "FORMAT_NOT_RECOGNIZED", "") for head in UNKNOWN),
        *((b"", "FILE_EMPTY", ""), (LEGACY_TORCH[:10], "RAW_PICKLE", ""), (b"\x80\x04\x95\x05", "RAW_PICKLE", "")),
        *((LEGACY_TAR, "LEGACY_TORCH_FILE", ""), (b" BDV\0\0\0\0\xe0\0\0\0", "FORMAT_NOT_SUPPORTED", "")),
        (b"NanoVDB2" + bytes(40), "FORMAT_NOT_SUPPORTED", ""),
        (b"\x89HDF\r\n\x1a\n", "FORMAT_NOT_RECOGNIZED", "ONNX"),
        (b"\x08\x01\x12\xf0", "FORMAT_NOT_RECOGNIZED", "TensorFlow"),
        (b"\x1c\0\0\0TFL3", "FORMAT_NOT_SUPPORTED", "TensorFlow Lite"),
        (b"version https://git-lfs.github.com/spec/v1\n", "FORMAT_NOT_RECOGNIZED", "git lfs pull"),
        *((zip_bytes([(f"{name}.json", b"{}")]), "FORMAT_NOT_SUPPORTED", "Keras") for name in ("config", "metadata")),
    ],
)
def test_everything_else_is_named_none_and_explained(head: bytes, reason: str, words: str) -> None:
    assert sniff_format(head) is None
    found, detail = explain_refusal(head)
    assert found == reason
    assert words in detail


def test_every_file_of_one_or_two_bytes_is_looked_at() -> None:
    for first in range(256):
        for head in (bytes([first]), *(bytes([first, second]) for second in range(0, 256, 5))):
            if sniff_format(head) is None:
                assert explain_refusal(head)[0], head


def test_sniffing_loads_nothing_heavy() -> None:
    heavy = {"numpy", "torch", "pydantic", "zipfile"}
    program = f"import sys, regnf_core.importing.containers.sniff; sys.exit(bool({heavy!r} & set(sys.modules)))"
    root = Path(__file__).resolve().parents[4]
    assert subprocess.run([sys.executable, "-S", "-c", program], cwd=root, check=False).returncode == 0
