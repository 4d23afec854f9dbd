from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from regnf_core.importing.containers.safetensors_header import read_header
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.checkpoints import write_small_checkpoint


def layout(header: object, body: bytes = b"", length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + body


def entry(begin: int, end: int, **values: Any) -> dict[str, Any]:
    return {"dtype": "F32", "shape": [(end - begin) // 4], "data_offsets": [begin, end]} | values


def test_a_sound_header_is_read() -> None:
    tensors = read_header(
        memoryview(layout({"b": entry(4, 8), "a": entry(0, 4), "__metadata__": {"k": "v"}}, bytes(8)))
    )
    assert tensors["a"].shape == (1,)
    assert tensors["b"].offset - tensors["a"].offset == 4


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "FILE_TRUNCATED"),
        (b"\x10\0\0\0\0\0\0\0{", "FILE_TRUNCATED"),
        (layout({"a": entry(0, 4)}, bytes(4), length=1 << 63), "SAFETENSORS_HEADER_TOO_LARGE"),
        (layout({"a": entry(0, 4)}, bytes(4), length=100 << 20), "SAFETENSORS_HEADER_TOO_LARGE"),
        (layout(b"{nonsense"), "SAFETENSORS_HEADER_MALFORMED"),
        (layout(b"\xff\xfe{}"), "SAFETENSORS_HEADER_MALFORMED"),
        (layout(b'{"a":' * 100_000), "SAFETENSORS_HEADER_MALFORMED"),
        (layout([1]), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": [1]}), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": entry(0, 4), "__metadata__": {"k": 1}}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": entry(0, 4, extra=1)}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": entry(0, 4, shape=[-1])}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": entry(0, 4, shape=[1.0])}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a": entry(0, 4, shape=[1 << 60])}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout({"a\0": entry(0, 4)}, bytes(4)), "SAFETENSORS_HEADER_MALFORMED"),
        (layout(b'{"a":' + json.dumps(entry(0, 4)).encode() + b',"a":1}', bytes(4)), "SAFETENSORS_DUPLICATE_KEY"),
        (layout({}, bytes(4)), "SAFETENSORS_LAYOUT"),
        (layout({f"t{i}": entry(0, 0) for i in range(2000)}), "SAFETENSORS_TOO_MANY_TENSORS"),
        (layout({"a": entry(0, 4, dtype="F8_E4M3")}, bytes(4)), "TENSOR_DTYPE"),
        (layout({"a": entry(0, 4), "b": entry(0, 4)}, bytes(4)), "SAFETENSORS_LAYOUT"),  # overlap
        (layout({"a": entry(0, 4), "b": entry(8, 12)}, bytes(12)), "SAFETENSORS_LAYOUT"),  # hole
        (layout({"a": entry(0, 4)}, bytes(8)), "SAFETENSORS_LAYOUT"),  # bytes behind
        (layout({"a": entry(0, 4, shape=[2])}, bytes(4)), "SAFETENSORS_LAYOUT"),
        (layout({"a": entry(0, 8)}, bytes(4)), "FILE_TRUNCATED"),
    ],
)
def test_faulty_headers_are_refused(data: bytes, reason: str) -> None:
    assert_refused(lambda: read_header(memoryview(data)), reason)


@pytest.fixture(scope="module")
def field_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("field")
    write_small_checkpoint(folder / "upload.ckpt")
    convert_file(folder / "upload.ckpt", folder, {"label": "ball"}, ImportLimits())
    return folder / FIELD_NAME


def test_a_field_file_may_be_uploaded_again(field_file: Path, tmp_path: Path) -> None:
    report = convert_file(field_file, tmp_path, None, ImportLimits())
    assert (tmp_path / FIELD_NAME).read_bytes() == field_file.read_bytes()
    assert report["label"] == "ball"
    assert (report["family"], report["kind"]) == ("regnf", "neus_facto")


def test_its_description_may_be_overruled(field_file: Path, tmp_path: Path) -> None:
    convert_file(field_file, tmp_path, {"label": "moon", "level_mask": 3, "contraction": "linf"}, ImportLimits())
    description = read_description(tmp_path / FIELD_NAME)
    assert (description["label"], description["level_mask"], description["contraction"]) == ("moon", 3, "linf")


def test_what_it_says_of_itself_stands(field_file: Path, tmp_path: Path) -> None:
    for said, reason in (
        ({"family": "sdfstudio_neus_facto"}, "FAMILY_NOT_SUPPORTED"),
        ({"hash": {"base_resolution": 8}}, "INVALID_DESCRIPTION"),
    ):
        assert_refused(partial(convert_file, field_file, tmp_path, said, ImportLimits()), reason)


def test_other_safetensors_files_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, layout({"a": entry(0, 4)}, bytes(4)))
    assert_refused(lambda: convert_file(path, tmp_path, None, ImportLimits()), "SAFE_FORMAT_INVALID")


def test_weights_that_are_not_finite_are_refused(field_file: Path, tmp_path: Path) -> None:
    data = bytearray(field_file.read_bytes())
    data[-4:] = np.float32("nan").tobytes()
    path = saved(tmp_path, bytes(data))
    assert_refused(lambda: convert_file(path, tmp_path, None, ImportLimits()), "FIELD_NOT_FINITE")


def described(field_file: Path, change: Callable[[dict[str, Any]], str]) -> bytes:
    """The field file with another text for its description."""
    data = field_file.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["__metadata__"]["field"] = change(json.loads(header["__metadata__"]["field"]))
    return layout(header, data[8 + length :])


@pytest.mark.parametrize("label", ["\ud800", "a\0b", "a\r\nX-Bad: 1", "a\n", "a\u202eb"])
def test_labels_that_no_file_can_hold_or_no_page_show_are_refused(field_file: Path, tmp_path: Path, label: str) -> None:
    """JSON can spell half a surrogate pair; UTF-8 cannot."""
    path = saved(tmp_path, described(field_file, lambda entries: json.dumps(entries | {"label": label})))
    assert_refused(lambda: convert_file(path, tmp_path / "out", None, ImportLimits()), "SAFE_FORMAT_INVALID")


@pytest.mark.parametrize("depth", [40, 300, 900, 5_000, 90_000])
@pytest.mark.parametrize(("opening", "closing"), [('{"a":', "}"), ("[", "]")])
def test_a_description_that_nests_deep_is_refused(
    field_file: Path, tmp_path: Path, depth: int, opening: str, closing: str
) -> None:
    """What can be read but not be written again, by this program or another's."""

    def nested(entries: dict[str, Any]) -> str:
        deep = opening * depth + "1" + closing * depth
        return json.dumps(entries | {"source": {"of": "@"}}).replace('"@"', deep)

    path = saved(tmp_path, described(field_file, nested))
    assert_refused(lambda: convert_file(path, tmp_path / "out", None, ImportLimits()), "SAFE_FORMAT_INVALID")


def test_the_budget_holds(field_file: Path, tmp_path: Path) -> None:
    limits = ImportLimits(tensor_bytes=1000)
    assert_refused(lambda: convert_file(field_file, tmp_path, None, limits), "TENSOR_TOO_LARGE")
