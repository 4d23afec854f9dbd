"""The safe format: what goes in comes out, and what is malformed is refused with its reason."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field, open_field
from regnf_core.schema.safe_format import parse_description, read_description, write_safe_field
from tests.core.fields.small_field import GRID, description, tensors

Tensors = dict[str, np.ndarray[Any, Any]]


def reason_of(action: Callable[[], object]) -> str:
    with pytest.raises(FieldFormatError) as caught:
        action()
    return caught.value.reason


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    values = description(label="chair", contraction="linf", source={"note": "größer"})
    write_safe_field(path, values, tensors(6))
    read = read_description(path)
    assert {name: read[name] for name in ("label", "contraction", "source", "bounds")} == {
        name: values[name] for name in ("label", "contraction", "source", "bounds")
    }
    assert read["hash"]["levels"] == GRID.levels
    parameters = {name: torch.from_numpy(array) for name, array in tensors(6).items()}
    expected = build_field(parse_description(values), parameters)
    points = torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(open_field(path).signed_distance(points), expected.signed_distance(points))
    assert torch.equal(open_field(path).bounds, torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=torch.float64))


def test_other_readers_of_safetensors_read_it(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    write_safe_field(path, description(), tensors())
    stored = load_file(path)
    assert stored.keys() == tensors().keys()
    assert all(np.array_equal(stored[name], array) for name, array in tensors().items())


def test_same_input_same_bytes(tmp_path: Path) -> None:
    write_safe_field(tmp_path / "a", description(), tensors())
    write_safe_field(tmp_path / "b", description(), dict(reversed(tensors().items())))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_half_precision_table(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    halved = tensors() | {"hash_table": tensors()["hash_table"].astype(np.float16)}
    write_safe_field(path, description(), halved)
    points = torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    write_safe_field(tmp_path / "whole", description(), tensors())
    exact = open_field(tmp_path / "whole").signed_distance(points)
    torch.testing.assert_close(open_field(path).signed_distance(points), exact, rtol=0, atol=5e-3)


def test_writing_and_describing_load_no_torch(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    write_safe_field(path, description(), tensors())
    program = (
        "import sys; from regnf_core.schema.safe_format import read_description\n"
        f"read_description({str(path)!r}); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "field.safetensors"
    write_safe_field(path, description(), tensors())
    before = path.read_bytes()

    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_safe_field(path, description(label="other"), tensors())
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["field.safetensors"]


def with_tensor(name: str, array: np.ndarray[Any, Any]) -> Tensors:
    return tensors() | {name: array}


def without_tensor(name: str) -> Tensors:
    return {key: array for key, array in tensors().items() if key != name}


@pytest.mark.parametrize(
    "faulty",
    [
        with_tensor("hash_table", tensors()["hash_table"][:-8]),
        with_tensor("hash_table", tensors()["hash_table"].astype(np.float64)),
        with_tensor("layers.0.weight", tensors()["layers.0.weight"][:, :-1]),
        with_tensor("layers.1.bias", tensors()["layers.1.bias"][:-1]),
        with_tensor("layers.2.weight", tensors()["layers.2.weight"][:0]),
        with_tensor("layers.1.weight", tensors()["layers.1.weight"][0, 0]),
        *(with_tensor("color.weight", tensors()["layers.1.weight"]), without_tensor("hash_table")),
        *(without_tensor("layers.1.bias"), without_tensor("layers.1.weight"), {"hash_table": tensors()["hash_table"]}),
    ],
)
def test_tensors_that_do_not_fit_the_description(faulty: Tensors, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    assert reason_of(lambda: write_safe_field(path, description(), faulty)) == "FIELD_SHAPES_MISMATCH"
    assert not path.exists()
    metadata = {"regnf": "2", "field": json.dumps(description())}
    save_file({name: np.ascontiguousarray(array) for name, array in faulty.items()}, path, metadata)
    assert reason_of(lambda: read_description(path)) == "FIELD_SHAPES_MISMATCH"
    assert reason_of(lambda: open_field(path)) == "FIELD_SHAPES_MISMATCH"


def test_the_old_name_of_an_entry_is_told(tmp_path: Path) -> None:
    values = description()
    with pytest.raises(FieldFormatError, match="did you mean `kind`"):
        write_safe_field(tmp_path / "field.safetensors", {"family": values.pop("kind"), **values}, tensors())


def test_numbers_that_are_not_finite(tmp_path: Path) -> None:
    faulty = tensors()
    faulty["layers.1.weight"][0, 0] = np.nan
    assert reason_of(lambda: write_safe_field(tmp_path / "f", description(), faulty)) == "FIELD_NOT_FINITE"


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (description(kind="pin_slam"), "FIELD_KIND_UNKNOWN"),
        (description(contraction="sphere"), "SAFE_FORMAT_INVALID"),
        (description(bounds=[[0, 0, 0], [1, 1, 0]]), "SAFE_FORMAT_INVALID"),
        (description(bounds=[[0, 0, 0], [1, 1, float("inf")]]), "SAFE_FORMAT_INVALID"),
        (description(bounds=[[0, 0], [1, 1]]), "SAFE_FORMAT_INVALID"),
        (description(level_mask=0), "SAFE_FORMAT_INVALID"),
        (description(grid_radius=0.0), "SAFE_FORMAT_INVALID"),
        (description(shiny=True), "SAFE_FORMAT_INVALID"),
        (description(hash=description()["hash"] | {"levels": 1000}), "SAFE_FORMAT_INVALID"),
        (description(hash=description()["hash"] | {"log2_table_size": 60}), "SAFE_FORMAT_INVALID"),
        (description(hash=description()["hash"] | {"per_level_scale": "x"}), "SAFE_FORMAT_INVALID"),
        (description(hash=description()["hash"] | {"resolutions": [8, 16]}), "FIELD_SHAPES_MISMATCH"),
        (["neus_facto"], "SAFE_FORMAT_INVALID"),
    ],
)
def test_descriptions_that_mean_nothing(values: Any, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    assert reason_of(lambda: write_safe_field(path, values, tensors())) == reason
    save_file(tensors(), path, {"regnf": "2", "field": json.dumps(values)})
    assert reason_of(lambda: read_description(path)) == reason


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        (None, "SAFE_FORMAT_INVALID"),
        ({"field": json.dumps(description())}, "SAFE_FORMAT_INVALID"),
        ({"regnf": "2"}, "SAFE_FORMAT_INVALID"),
        ({"regnf": "3", "field": json.dumps(description())}, "SAFE_FORMAT_VERSION"),
        ({"regnf": "2", "field": "{"}, "SAFE_FORMAT_INVALID"),
        ({"regnf": "2", "field": "[" * 100_000}, "SAFE_FORMAT_INVALID"),
        ({"regnf": "2", "field": " " * (2 << 20)}, "SAFE_FORMAT_INVALID"),
    ],
)
def test_metadata_that_is_not_ours(metadata: dict[str, str] | None, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    save_file(tensors(), path, metadata)
    assert reason_of(lambda: open_field(path)) == reason


@pytest.mark.parametrize("keep", [0, 5, 8, 100, -1])
def test_bytes_that_are_no_safetensors(keep: int, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    write_safe_field(path, description(), tensors())
    path.write_bytes(path.read_bytes()[:keep])
    assert reason_of(lambda: read_description(path)) == "SAFE_FORMAT_INVALID"
    assert reason_of(lambda: open_field(path)) == "SAFE_FORMAT_INVALID"


def test_an_absent_file_is_the_operating_system_s_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_description(tmp_path / "absent")
