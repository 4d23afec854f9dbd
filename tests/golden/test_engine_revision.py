"""The engine's revision cannot be forgotten: its code has a digest, and its results are recorded."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest

from regnf_core.version import ENGINE_REVISION
from scripts.engine_revision import ROOT, changes_since, next_record, write_revision
from scripts.engine_sources import source_digest
from tests.golden.cases import cases
from tests.golden.records import Recorded

GOLDEN = {case.name: case for case in cases()}


def test_changed_code_was_followed_by_a_look_at_the_results() -> None:
    recorded = Recorded.load()
    assert source_digest(ROOT) == recorded.sources, "the engine's code has changed: python -m scripts.engine_revision"
    assert recorded.revision == ENGINE_REVISION, "raise the revision by python -m scripts.engine_revision alone"


def test_the_same_results_refresh_the_digest_and_keep_the_values() -> None:
    recorded, name = Recorded.load(), "robust-any-orientation"
    found = copy.deepcopy(recorded.results)
    found[name]["T_object_scene"][0][3] += 1e-8  # another processor
    changes = changes_since(recorded, GOLDEN, found)
    assert changes == []
    assert next_record(recorded, found, "new", changes, raised=False) == Recorded(
        recorded.revision, "new", recorded.results
    )


def test_other_results_raise_the_revision_and_are_recorded() -> None:
    recorded, name = Recorded.load(), "robust-any-orientation"
    found = copy.deepcopy(recorded.results)
    found[name]["verdict"] = "rejected"
    changes = changes_since(recorded, GOLDEN, found)
    assert changes == [f"{name}: verdict registered -> rejected"]
    assert next_record(recorded, found, "new", changes, raised=False) == Recorded(recorded.revision + 1, "new", found)
    assert next_record(recorded, recorded.results, "new", [], raised=True).revision == recorded.revision + 1


def test_a_new_case_changes_no_result_and_a_lost_one_does() -> None:
    recorded = Recorded.load()
    fewer = Recorded(3, "old", {name: one for name, one in recorded.results.items() if name != "library-search"})
    assert changes_since(fewer, GOLDEN, recorded.results) == []
    assert set(next_record(fewer, recorded.results, "new", [], raised=False).results) == set(GOLDEN)
    golden = {name: case for name, case in GOLDEN.items() if name != "library-search"}
    assert changes_since(recorded, golden, fewer.results) == ["library-search: no longer a case"]


def test_the_revision_is_written_where_it_is_read(tmp_path: Path) -> None:
    module = tmp_path / "engine_revision.py"
    module.write_text('"""Text."""\n\nENGINE_REVISION = 41\n', encoding="utf-8")
    write_revision(42, module)
    assert module.read_text(encoding="utf-8") == '"""Text."""\n\nENGINE_REVISION = 42\n'
    module.write_text("OTHER = 41\n", encoding="utf-8")
    with pytest.raises(ValueError, match="ENGINE_REVISION"):
        write_revision(42, module)
