"""`regnf register --recording`: what it writes, and what it refuses before any work."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.cli.conftest import Run
from tests.core.viewing.test_recording import matrix_of, rows_of


def test_the_recording_is_the_only_file(run: Run, demo: list[object], tmp_path: Path) -> None:
    path = tmp_path / "new" / "chair.rrd"
    outcome = run(*demo, "--json", "--recording", path)
    assert outcome.code == 0, outcome.stderr
    assert [one.name for one in path.parent.iterdir()] == ["chair.rrd"]
    document = json.loads(outcome.stdout)
    rows = rows_of(path)
    expected = np.array(document["T_scene_object"]["matrix"])
    np.testing.assert_allclose(matrix_of(rows["/scene/object"][-1]), expected, atol=2e-6)
    assert "/scene/detection" in rows
    assert document["object"] in rows["/verdict"][0]["TextDocument:text"][0]


@pytest.mark.parametrize(
    ("name", "more", "reason"),
    [
        ("chair.bin", [], "INVALID_OPTIONS"),
        ("folder.rrd", [], "FILE_IS_FOLDER"),
        ("file/chair.rrd", [], "FILE_IS_NO_FOLDER"),
        ("chair.rrd", ["--server", "http://127.0.0.1:1"], "INVALID_OPTIONS"),
    ],
)
def test_what_cannot_be_written_is_refused(
    run: Run, demo: list[object], tmp_path: Path, name: str, more: list[str], reason: str
) -> None:
    (tmp_path / "folder.rrd").mkdir()
    (tmp_path / "file").write_text("")
    outcome = run(*demo, "--recording", tmp_path / name, *more)
    assert outcome.code == 2
    assert outcome.stderr.startswith(f"{reason} ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.rrd"]
