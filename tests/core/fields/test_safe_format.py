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


def reason_of(action: Callable[[], object]) -> str | None:
    try:
        action()
    except FieldFormatError as error:
        return error.reason
    return None


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


def test_other_readers_of_safetensors_read_it_and_the_order_of_the_tensors_is_no_matter(tmp_path: Path) -> None:
    write_safe_field(tmp_path / "a", description(), tensors())
    write_safe_field(tmp_path / "b", description(), dict(reversed(tensors().items())))
    stored = load_file(tmp_path / "a")
    assert stored.keys() == tensors().keys()
    assert all(np.array_equal(stored[name], array) for name, array in tensors().items())
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


def without(name: str) -> Tensors:
    return {key: array for key, array in tensors().items() if key != name}


SOUND = tensors()
FAULTY: list[Tensors] = [
    *(SOUND | {"hash_table": array} for array in (SOUND["hash_table"][:-8], SOUND["hash_table"].astype(np.float64))),
    SOUND | {"layers.0.weight": SOUND["layers.0.weight"][:, :-1]},
    *(
        SOUND | {"layers.1.bias": SOUND["layers.1.bias"][:-1]},
        SOUND | {"layers.2.weight": SOUND["layers.2.weight"][:0]},
    ),
    SOUND | {"layers.1.weight": SOUND["layers.1.weight"][0, 0]},
    SOUND | {"color.weight": SOUND["layers.1.weight"]},
    *(without("hash_table"), without("layers.1.bias"), without("layers.1.weight"), {"hash_table": SOUND["hash_table"]}),
]


@pytest.mark.parametrize("faulty", FAULTY)
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


HASH = description()["hash"]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (description(kind="pin_slam"), "FIELD_KIND_UNKNOWN"),
        (description(hash=HASH | {"resolutions": [8, 16]}), "FIELD_SHAPES_MISMATCH"),
        (["neus_facto"], "SAFE_FORMAT_INVALID"),
        *(
            (description(**{name: value}), "SAFE_FORMAT_INVALID")
            for name, value in (
                *(("contraction", "sphere"), ("level_mask", 0), ("grid_radius", 0.0), ("shiny", True)),
                *(("bounds", [[0, 0, 0], [1, 1, last]]) for last in (0, float("inf"))),
                ("bounds", [[0, 0], [1, 1]]),
                *(
                    ("hash", HASH | odd)
                    for odd in ({"levels": 1000}, {"log2_table_size": 60}, {"per_level_scale": "x"})
                ),
            )
        ),
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
        *((told, "SAFE_FORMAT_INVALID") for told in (None, {"field": json.dumps(description())}, {"regnf": "2"})),
        ({"regnf": "3", "field": json.dumps(description())}, "SAFE_FORMAT_VERSION"),
        *(({"regnf": "2", "field": text}, "SAFE_FORMAT_INVALID") for text in ("{", "[" * 100_000, " " * (2 << 20))),
    ],
)
def test_metadata_that_is_not_ours(metadata: dict[str, str] | None, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    save_file(tensors(), path, metadata)
    assert reason_of(lambda: open_field(path)) == reason


def test_bytes_that_are_no_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "field.safetensors"
    write_safe_field(path, description(), tensors())
    whole = path.read_bytes()
    for keep in (0, 5, 8, 100, -1):
        path.write_bytes(whole[:keep])
        for reader in (read_description, open_field):
            assert reason_of(lambda reader=reader: reader(path)) == "SAFE_FORMAT_INVALID"  # type: ignore[misc]


def test_an_absent_file_is_the_operating_system_s_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_description(tmp_path / "absent")
