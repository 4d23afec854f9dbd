"""Rows of evidence from a world made here: the right object's, and those of a similar one, which are all wrong."""

from __future__ import annotations

from pathlib import Path

import trimesh

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.evidence import Gathering, evidence_of_world
from benchmarks.worlds.making import Task, make
from benchmarks.worlds.similar_objects import SIMILAR
from regnf_core.robust.verdict.evidence import SPEAKS_FOR


def test_rows_of_the_right_object_and_of_a_similar_one(tmp_path: Path) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for number in range(12):
        trimesh.creation.icosphere(radius=0.08 + 0.01 * number).export(meshes / f"ball{number}.ply")
    task = Task(12, "single", "mesh", (meshes,), tmp_path / "worlds")
    make(task)
    rows = evidence_of_world(task.home, [task.home], Gathering(cases=1, asked=("right", "similar")))
    similar = [row for row in rows if row["model"] == SIMILAR]
    right = [row for row in rows if row["model"] != SIMILAR]
    assert {row["model"] for row in right} == {rows[0]["object"]}
    assert min(row["mssd"] for row in right) <= SUCCESS
    assert similar
    assert {row["mssd"] for row in similar} == {9.0}
    for kind in (similar, right):
        chosen = [row for row in kind if row["winner"]]
        assert len(chosen) == 1
        assert chosen[0]["verdict"] in ("registered", "ambiguous", "rejected")
        assert set(chosen[0]["features"]) == set(SPEAKS_FOR)
