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


def test_names_what_the_gate_takes() -> None:
    assert sniff_format(torch_zip()) == "torch-zip"
    assert sniff_format(LEGACY_TORCH) == "torch-legacy"
    assert sniff_format((64).to_bytes(8, "little") + b'{"a":') == "safetensors"


def test_names_meshes() -> None:
    facet = struct.pack("<12fH", 0, 0, 1, *range(1, 10), 0)
    assert sniff_format(b"ply\nformat binary_little_endian 1.0\n") == "ply"
    assert sniff_format(b"glTF\x02\0\0\0") == "glb"
    assert sniff_format(b"solid thing\n  facet normal 0 0 1\n") == "stl"
    assert (
        sniff_format((b"solid, says the header".ljust(80) + struct.pack("<I", 900) + 20 * facet)[:HEAD_BYTES]) == "stl"
    )
    assert sniff_format(b"# Blender v2.92\n# \xc3\xa9\nmtllib a.mtl\no Cube\n") == "obj"
    assert sniff_format(b"\r\nv 1.0 -2e-3 .5\r\n") == "obj"
    assert sniff_format(b"# exported by an OBJ writer of many words\n" * 20) == "obj"
    assert sniff_format(b'{"asset": {"version": "2.0"}, "buffers": []}') == "gltf"
    assert sniff_format(b"VERSION 0.7\nFIELDS x y z\n") == sniff_format(b"# .PCD v.7\nFIELDS x\n") == "pcd"
    assert sniff_format(b"1 2 3\n4e1 5 6\n") == sniff_format(b"# x y z\n2\n1,2,3\n") == "xyz"
    assert sniff_format(b"1.5 2.5 3.5 0.1 0.2 0.3\n" * 30) == "xyz"


def _license(sign: str) -> bytes:
    return (f"{sign} Permission is granted to whoever reads these words.\n" * 40).encode()


@pytest.mark.parametrize(
    ("head", "format_"),
    [
        (b"# File exported by Houdini\n# 8 points\ng\nv 0 0 1\nv 0 1 1\n", "obj"),
        (_license("#") + b"v 0 0 1\n", "obj"),
        (_license("#") * 9, "obj"),
        (b"\xef\xbb\xbf# a mesh\r\n\r\nmaplib a\r\no\r\nv 0 0 1\r\n", "obj"),
        (b"solid " + b"/" * 3000 + b"\nfacet normal 0 0 1\n", "stl"),
        (b"\xef\xbb\xbf \n SOLID X\n FACET NORMAL 0 0 1\n", "stl"),
        (b"solid\n" + b"facet normal 0 0 1\n", "stl"),
        (b"\xef\xbb\xbfply \r\nformat ascii 1.0\r\n", "ply"),
        (_license("//") + b"1 2 3\n4 5 6\n", "xyz"),
    ],
)
def test_the_first_statement_decides_wherever_it_stands(head: bytes, format_: str) -> None:
    assert sniff_format(head[:HEAD_BYTES]) == format_


@pytest.mark.parametrize("head", [b"g\n", b"end of the story\nonce more\n", b"solid\x00\x01", _license("%")])
def test_one_short_word_is_no_mesh(head: bytes) -> None:
    assert sniff_format(head) is None


def test_arrays_and_databases_are_named() -> None:
    assert sniff_format(zip_bytes([("points.npy", b"\x93NUMPY")])) == "npz"
    assert sniff_format(b"SQLite format 3\x00".ljust(100, b"\x01")) == "sqlite"


def test_archives_of_runs_are_named() -> None:
    assert sniff_format(zip_bytes([("points.txt", b"1 2 3")])) == "zip"
    assert sniff_format(b"run/config.yml".ljust(257, b"\0") + b"ustar\x0000") == "tar"
    assert sniff_format(b"\x1f\x8b\x08\x00") == "gzip"
    assert sniff_format(b"BZh91AY&SY") == "bzip2"
    assert sniff_format(b"\xfd7zXZ\x00\x00\x04") == "xz"


def test_a_zip_cut_short_is_still_a_torch_archive() -> None:
    assert sniff_format(b"PK\x03\x04\x00") == "torch-zip"


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (b"", "FILE_EMPTY"),
        (b"x", "FORMAT_NOT_RECOGNIZED"),
        (PNG, "FORMAT_NOT_RECOGNIZED"),
        (LEGACY_TORCH[:10], "RAW_PICKLE"),
        (LEGACY_TAR, "LEGACY_TORCH_FILE"),
        (b"\x80\x04\x95\x05", "RAW_PICKLE"),
        (b'{"frames": [], "camera_model": "OPENCV"}', "FORMAT_NOT_RECOGNIZED"),
        (b"<?xml version='1.0'?><svg/>", "FORMAT_NOT_RECOGNIZED"),
        (b"OFFICE hours", "FORMAT_NOT_RECOGNIZED"),
        (b"VERSION 3\n", "FORMAT_NOT_RECOGNIZED"),
        (b"1 2\n3 4\n", "FORMAT_NOT_RECOGNIZED"),
        (b"1 2 3\n4 5\n", "FORMAT_NOT_RECOGNIZED"),
        (b";", "FORMAT_NOT_RECOGNIZED"),
        (b",;\n,\n", "FORMAT_NOT_RECOGNIZED"),
        (b"v is for vertex", "FORMAT_NOT_RECOGNIZED"),
        (b"# a list of things\nv 1 2 3\x00", "FORMAT_NOT_RECOGNIZED"),
        (bytes(80) + b"\x08\0\0\0" + bytes(428), "FORMAT_NOT_RECOGNIZED"),  # an STL file's facets have corners
        (b"x" * 512, "FORMAT_NOT_RECOGNIZED"),
        (b" BDV\0\0\0\0\xe0\0\0\0", "FORMAT_NOT_SUPPORTED"),
        (b"NanoVDB2" + bytes(40), "FORMAT_NOT_SUPPORTED"),
        (b"7z\xbc\xaf\x27\x1c", "FORMAT_NOT_RECOGNIZED"),
        (b"\x89HDF\r\n\x1a\n", "FORMAT_NOT_RECOGNIZED"),
        (b"\x08\x01\x12\xf0", "FORMAT_NOT_RECOGNIZED"),
        (b"\x1c\0\0\0TFL3", "FORMAT_NOT_SUPPORTED"),
        (zip_bytes([("metadata.json", b"{}")]), "FORMAT_NOT_SUPPORTED"),
    ],
)
def test_everything_else_is_named_none_and_explained(head: bytes, reason: str) -> None:
    assert sniff_format(head) is None
    assert explain_refusal(head)[0] == reason


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"\x89HDF\r\n\x1a\n", "ONNX"),
        (b"\x08\x01\x12\xf0", "TensorFlow"),
        (b"\x1c\0\0\0TFL3", "TensorFlow Lite"),
        (zip_bytes([("config.json", b"{}")]), "Keras"),
    ],
)
def test_files_of_others_are_told_what_they_are(head: bytes, words: str) -> None:
    assert words in explain_refusal(head)[1]


def test_a_line_of_separators_says_nothing() -> None:
    assert sniff_format(b"0,0,1\n;\n0;1;0\n,\n") == "xyz"


def test_every_file_of_one_or_two_bytes_is_looked_at() -> None:
    for first in range(256):
        for head in (bytes([first]), *(bytes([first, second]) for second in range(256))):
            if sniff_format(head) is None:
                assert explain_refusal(head)[0], head


def test_sniffing_loads_nothing_heavy() -> None:
    heavy = {"numpy", "torch", "pydantic", "zipfile"}
    program = f"import sys, regnf_core.importing.containers.sniff; sys.exit(bool({heavy!r} & set(sys.modules)))"
    root = Path(__file__).resolve().parents[4]
    assert subprocess.run([sys.executable, "-S", "-c", program], cwd=root, check=False).returncode == 0
