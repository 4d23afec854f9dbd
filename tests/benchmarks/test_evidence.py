"""Rows of evidence from a world made here: the right object's, and those of a similar one, which are all wrong."""

from __future__ import annotations

from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.evidence import Gathering, evidence_of_world
from benchmarks.worlds.making import Task
from benchmarks.worlds.similar_objects import SIMILAR
from regnf_core.robust.verdict.evidence import SPEAKS_FOR


def test_rows_of_the_right_object_and_of_a_similar_one(world: Task) -> None:
    rows = evidence_of_world(world.home, [world.home], Gathering(cases=1, asked=("right", "similar")))
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
