"""`regnf register --recording`: what it writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tests.cli.conftest import Run
from tests.core.viewing.test_recording import matrix_of, rows_of


def test_the_recording_is_the_only_file(run: Run, demo: list[object], tmp_path: Path) -> None:
    path = tmp_path / "new" / "chair.rrd"
    outcome = run(*demo, "--json", "--recording", path, code=0)
    assert [one.name for one in path.parent.iterdir()] == ["chair.rrd"]
    document = json.loads(outcome.stdout)
    rows = rows_of(path)
    expected = np.array(document["T_scene_object"]["matrix"])
    np.testing.assert_allclose(matrix_of(rows["/scene/object"][-1]), expected, atol=2e-6)
    assert "/scene/detection" in rows
    assert document["object"] in rows["/verdict"][0]["TextDocument:text"][0]
