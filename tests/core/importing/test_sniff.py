from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from regnf_core.importing.sniff import explain_refusal, sniff_format
from tests.core.importing.archives import torch_zip, zip_bytes

PNG = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
LEGACY_TORCH = bytes.fromhex("80028a0a6cfc9c46f9206aa850192e80024de903")
LEGACY_TAR = b"sys_info".ljust(257, b"\0") + b"ustar\x0000"


def test_names_what_the_gate_takes() -> None:
    assert sniff_format(torch_zip()) == "torch-zip"
    assert sniff_format((64).to_bytes(8, "little") + b'{"a":') == "safetensors"


def test_a_zip_cut_short_is_still_a_torch_archive() -> None:
    assert sniff_format(b"PK\x03\x04\x00") == "torch-zip"


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (b"", "FILE_EMPTY"),
        (b"x", "FORMAT_NOT_RECOGNISED"),
        (PNG, "FORMAT_NOT_RECOGNISED"),
        (LEGACY_TORCH, "LEGACY_TORCH_FILE"),
        (LEGACY_TAR, "LEGACY_TORCH_FILE"),
        (b"\x80\x04\x95\x05", "RAW_PICKLE"),
        (b"ply\nformat binary_little_endian 1.0\n", "FORMAT_NOT_SUPPORTED"),
        (zip_bytes([("points.npy", b"\x93NUMPY")]), "FORMAT_NOT_SUPPORTED"),
        (b"7z\xbc\xaf\x27\x1c", "FORMAT_NOT_RECOGNISED"),
        (b"\x1f\x8b\x08\x00", "FORMAT_NOT_RECOGNISED"),
    ],
)
def test_everything_else_is_named_none_and_explained(head: bytes, reason: str) -> None:
    assert sniff_format(head) is None
    assert explain_refusal(head)[0] == reason


def test_sniffing_loads_nothing_heavy() -> None:
    heavy = {"numpy", "torch", "pydantic", "zipfile"}
    program = f"import sys, regnf_core.importing.sniff; sys.exit(bool({heavy!r} & set(sys.modules)))"
    root = Path(__file__).resolve().parents[3]
    assert subprocess.run([sys.executable, "-S", "-c", program], cwd=root, check=False).returncode == 0
