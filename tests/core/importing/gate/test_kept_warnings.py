"""A field file keeps what its import has warned of, for whoever opens it later."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.field_notes import kept_warnings
from regnf_core.field_source import find_source
from regnf_core.fields.build import open_field as open_safe_field
from regnf_core.importing.gate.gate import FIELD_NAME
from regnf_core.in_memory import FieldWarning
from regnf_core.loading import open_field, safe_field
from regnf_core.schema.safe_format import add_to_source, read_description, write_safe_field
from tests.core.importing.gate.test_candidates import reading
from tests.core.importing.in_process import convert


def ball(folder: Path, factor: float = 3.0, name: str = "ball.npz") -> Path:
    """Distances ``factor`` times too large on a grid."""
    grid = reading(0.5)
    np.savez(folder / name, sdf=factor * grid.tensors["values"], origin=[-1.0] * 3, spacing=2.0 / 23.0)
    return folder / name


def test_a_field_file_keeps_the_warnings_of_its_import(tmp_path: Path) -> None:
    warned = tuple(convert(ball(tmp_path), tmp_path / "out")["warnings"])
    assert [one.partition(":")[0] for one in warned] == ["GRADIENT_NOT_UNIT"]
    kept = tmp_path / "out" / FIELD_NAME
    assert safe_field(find_source(kept)).notes.warnings == warned
    with pytest.warns(FieldWarning, match="GRADIENT_NOT_UNIT"):
        open_field(kept)
    assert tuple(convert(kept, tmp_path / "again")["warnings"]) == warned
    convert(ball(tmp_path, 1.0, "true.npz"), tmp_path / "true")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_field(tmp_path / "true" / FIELD_NAME)


def test_notes_are_added_in_place(tmp_path: Path) -> None:
    path, one = tmp_path / FIELD_NAME, reading(0.5)
    write_safe_field(path, one.description, dict(one.tensors), room=2000)
    before, size = open_safe_field(path), path.stat().st_size
    add_to_source(path, {"warnings": ['A_WORD: "so" \u00e9']})
    add_to_source(path, {"more": 1})
    assert path.stat().st_size == size
    assert read_description(path)["source"] == {"warnings": ['A_WORD: "so" \u00e9'], "more": 1}
    points = before.bounds.float()
    assert (open_safe_field(path).signed_distance(points) == before.signed_distance(points)).all()
    with pytest.raises(FieldFormatError) as caught:
        add_to_source(path, {"text": "x" * 3000})
    assert caught.value.reason == "SAFE_FORMAT_INVALID"
    assert "text" not in read_description(path)["source"]


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        (["A_WORD: so", "ANOTHER: too"], ("A_WORD: so", "ANOTHER: too")),
        (["no word", 3, None, ["A_WORD: so"], "A_WORD: \x1b[2J", "word: so", "A_WORD:so"], ()),
        ("A_WORD: so", ()),
        ({"A_WORD": "so"}, ()),
        (None, ()),
        (["A_WORD: " + "x" * 10_000], ("A_WORD: " + "x" * 392,)),
        ([f"WORD_{number}: so" for number in range(100)], tuple(f"WORD_{number}: so" for number in range(16))),
    ],
)
def test_what_a_file_says_it_was_warned_of_is_checked(values: Any, kept: tuple[str, ...]) -> None:
    assert kept_warnings(values) == kept
