"""Inputs that fuzzers have found, one for each outcome of each stage: every one still ends as it did."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.core.importing.fuzzing.corpus import Corpus, distill
from tests.core.importing.fuzzing.stages import run_stage

FOLDER = Path(__file__).parent / "corpus"
_MOST_BYTES = 1 << 20
KEPT = Corpus(FOLDER).all()


@pytest.mark.parametrize("stage", sorted({kept.stage for kept in KEPT}))
def test_every_input_ends_as_it_did(stage: str, tmp_path: Path) -> None:
    inputs = [kept for kept in KEPT if kept.stage == stage]
    ended = {kept.path.name: run_stage(stage, kept.data, tmp_path) for kept in inputs}
    assert ended == {kept.path.name: kept.outcome for kept in inputs}
    assert list(tmp_path.iterdir()) == []


def test_the_corpus_is_small_and_says_much() -> None:
    assert sum(kept.path.stat().st_size for kept in KEPT) < _MOST_BYTES
    assert len({kept.outcome for kept in KEPT}) > 50


def test_what_is_worth_building_upon_is_kept(tmp_path: Path) -> None:
    corpus = Corpus(tmp_path / "all")
    assert corpus.offer("mesh", "MESH_INVALID", b"long")
    assert not corpus.offer("mesh", "MESH_INVALID", b"as long")
    assert not corpus.offer("mesh", "MESH_INVALID", b"new!", new_step=True)
    assert not corpus.offer("mesh", "MESH_INVALID", b"low")
    again = Corpus(tmp_path / "all")
    assert sorted(again.of("mesh")) == [b"long", b"low", b"new!"]
    assert not again.offer("mesh", "MESH_INVALID", b"same")
    assert distill(tmp_path / "all", tmp_path / "few") == 1
    assert [(kept.stage, kept.outcome, kept.data) for kept in Corpus(tmp_path / "few").all()] == [
        ("mesh", "MESH_INVALID", b"low")
    ]
