"""`regnf populate` and `regnf compare`: what is printed and written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.cli.conftest import DATA, Run
from tests.core.population.rooms import bracket, chair, error_of, pose, room

CHAIR, BRACKET = pose(0.4, -0.3, 0.0, 25.0), pose(-0.6, 0.4, 0.0, 130.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms")
    (folder / "library").mkdir()
    for name, mesh in (("chair", chair()), ("bracket", bracket())):
        mesh.export(folder / "library" / f"{name}.ply")
    for name, things in (("before", [(chair(), CHAIR), (bracket(), BRACKET)]), ("after", [(chair(), CHAIR)])):
        field = room(things)
        trimesh.Trimesh(field.vertices, field.faces, process=False).export(folder / f"{name}.ply")
    return folder


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, files: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(files / "cache"))


def test_everything_is_found_written_and_can_be_edited(run: Run, files: Path, tmp_path: Path) -> None:
    asked = ["populate", files / "before.ply", files / "library", "--object-unit", "m", "--output", tmp_path / "out"]
    told = json.loads(run(*asked, "--json", code=0).stdout)
    names = {Path(one["object"]).stem: one for one in told["placements"]}
    assert names.keys() == {"chair", "bracket"}
    for name, mesh, truth in (("chair", chair(), CHAIR), ("bracket", bracket(), BRACKET)):
        T = np.array(names[name]["T_scene_object"]["matrix"])
        there = np.asarray(mesh.vertices) @ (T - truth)[:3, :3].T + (T - truth)[:3, 3]
        assert np.abs(there).max() < 0.02
    assert json.loads((tmp_path / "out" / "placements.json").read_text()) == told
    edits = json.loads((tmp_path / "out" / "edits.json").read_text())
    assert {Path(one["object"]).name for one in edits} == {"chair.ply", "bracket.ply"}
    assert {one["kind"] for one in edits} == {"substitution"}
    loaded = trimesh.load(tmp_path / "out" / "scene.glb")
    assert len(loaded.geometry) == 2


def test_what_is_gone_is_told(run: Run, files: Path) -> None:
    asked = ["compare", files / "before.ply", files / "after.ply", files / "library", "--object-unit", "m", "--json"]
    changes = json.loads(run(*asked, code=0).stdout)["changes"]
    assert sorted((one["change"], Path(one["object"]).stem) for one in changes) == [
        ("gone", "bracket"),
        ("stayed", "chair"),
    ]


def test_what_cannot_be_done_is_refused(run: Run, files: Path, tmp_path: Path) -> None:
    scene, library = files / "before.ply", files / "library"
    refused = run("populate", scene, library, "--worlds", "blender", "--output", tmp_path / "out", code=2)
    assert "INVALID_OPTIONS" in refused.stderr
    refused = run("populate", DATA / "frame", library, code=2)
    assert "regnf fuse" in refused.stderr
    (tmp_path / "empty").mkdir()
    assert "LIBRARY_EMPTY" in run("populate", scene, tmp_path / "empty", code=2).stderr


def test_errors_of_the_helper_are_shares_of_the_size() -> None:
    from regnf_core.geometry.sim3 import Sim3

    T = Sim3.identity()
    moved = np.eye(4)
    moved[0, 3] = np.linalg.norm(np.ptp(np.asarray(chair().vertices), axis=0))
    assert error_of(chair(), T, moved) == pytest.approx(1.0)
