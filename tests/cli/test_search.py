"""`regnf search`: which files are a library, what is printed of a ranking, and what is kept for the next time."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from regnf_cli.report import show_ranking
from regnf_core import object_models
from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.field_files import library_files
from regnf_core.field_source import find_source
from regnf_core.object_models import object_model
from regnf_core.options import RobustOptions
from tests.cli.conftest import DATA, Answers, Run, Serve, service

CHAIRS = [DATA / "dining-chair.safetensors", DATA / "armchair.safetensors"]
DEMO: list[object] = ["search", DATA / "mix-room.safetensors", *CHAIRS, "--detection", DATA / "detection.json"]


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_the_right_chair_comes_first(run: Run, tmp_path: Path) -> None:
    outcome = run(*DEMO, "--json", "--output", tmp_path / "out", code=0)
    document = json.loads(outcome.stdout)
    assert (document["object"], document["verdict"]) == (str(CHAIRS[1]), "registered")
    assert [one["object"] for one in document["candidates"]] == [str(CHAIRS[1]), str(CHAIRS[0])]
    assert document["candidates"][0]["T_object_scene"] == document["T_object_scene"]
    assert document["T_object_scene"]["scale"] == pytest.approx(1.25, rel=0.01)
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (written["object"], len(written["candidates"])) == (document["object"], 2)
    assert len(list((tmp_path / "cache" / "regnf" / "object-models").iterdir())) == 2


def test_a_model_is_kept_and_made_again_when_it_does_not_read_or_is_of_an_older_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = object_model(find_source(CHAIRS[0]), RobustOptions())
    (kept,) = (tmp_path / "cache" / "regnf" / "object-models").iterdir()
    again = object_model(find_source(CHAIRS[0]), RobustOptions())
    assert first.samples.points.equal(again.samples.points)
    half = kept.read_bytes()[:100]
    kept.unlink()  # rather than shortened in place: what was read from it is mapped
    kept.write_bytes(half)
    assert object_model(find_source(CHAIRS[0]), RobustOptions()).samples.points.equal(first.samples.points)
    assert kept.stat().st_size > 100
    few = object_model(find_source(CHAIRS[0]), RobustOptions(object_samples=300))
    assert len(few.samples) < len(first.samples)
    assert list(kept.parent.iterdir()) == [kept]
    kept.unlink()
    kept.write_bytes(b"of an older engine")
    monkeypatch.setattr(object_models, "ENGINE_REVISION", object_models.ENGINE_REVISION + 1)
    object_model(find_source(CHAIRS[0]), RobustOptions())
    assert kept.read_bytes() == b"of an older engine"
    assert len(list(kept.parent.iterdir())) == 2


def test_what_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "chair.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0{")
    with pytest.raises(FieldFormatError, match=r"chair\.safetensors: "):
        object_model(find_source(tmp_path / "chair.safetensors"), RobustOptions())
    head = (DATA / "armchair.safetensors").read_bytes()[:600]
    for number in range(513):
        (tmp_path / f"{number}.safetensors").write_bytes(head)
    with pytest.raises(InvalidInputError) as caught:
        library_files([tmp_path])
    assert caught.value.reason == "LIBRARY_TOO_LARGE"


def test_a_library_is_the_fields_of_its_folders_each_once(tmp_path: Path) -> None:
    for name in ("armchair", "dining-chair"):
        shutil.copy(DATA / f"{name}.safetensors", tmp_path)
    (tmp_path / "README.md").write_text("chairs")
    (tmp_path / "empty.safetensors").touch()
    (tmp_path / "more").mkdir()
    arm, dining = tmp_path / "armchair.safetensors", tmp_path / "dining-chair.safetensors"
    assert library_files([tmp_path]) == [arm, dining]
    assert library_files([dining, tmp_path, tmp_path / "more" / ".." / arm.name]) == [dining, arm]
    with pytest.raises(InvalidInputError) as caught:
        library_files([tmp_path / "more"])
    assert caught.value.reason == "LIBRARY_EMPTY"


def test_the_published_method_searches_nothing(run: Run, tmp_path: Path) -> None:
    (tmp_path / "options.json").write_text('{"preset": "paper"}')
    outcome = run(*DEMO, "--options", tmp_path / "options.json", code=2)
    assert outcome.stderr.startswith("PRESET_UNSUITABLE ")


def candidate(name: str, stage: str, score: float | None, verdict: str | None = None) -> dict[str, Any]:
    reason = "NO_SURFACE_IN_OBJECT" if stage == "unusable" else "BECAUSE" if verdict else None
    return {"object": name, "stage": stage, "score": score, "verdict": verdict, "verdict_reason": reason}


def test_a_ranking_is_printed_as_far_as_asked(capfd: pytest.CaptureFixture[str]) -> None:
    sure = {"probability": 0.412, "level": None}
    first, second = candidate("[a]", "refined", 0.01, "rejected") | sure, candidate("b", "coarse", 0.2)
    rest = [candidate("c", "signature", None), candidate("air", "unusable", None)]
    show_ranking({"candidates": [first, second, *rest]}, 2)
    lines = [line.split() for line in capfd.readouterr().out.splitlines()]
    assert lines[2:] == [
        ["1", "[a]", "0.0100", "41.2", "%", "(below", "both", "levels)", "rejected", "(BECAUSE)"],
        ["2", "b", "0.2000", "not", "refined", "(coarse)"],
        ["and", "1", "more"],
        ["no", "object:", "air", "(NO_SURFACE_IN_OBJECT)"],
    ]


def test_a_ranking_says_whether_candidates_can_be_told_apart(capfd: pytest.CaptureFixture[str]) -> None:
    ranked = [candidate(name, "refined", 0.01, "registered") for name in "abc"]
    ranked[1]["difference"] = {"differs": 0.05, "seen": 0.037, "favor": 1.0, "distinguishable": True}
    ranked[2]["difference"] = {"differs": 0.05, "seen": 0.004, "favor": 0.0, "distinguishable": False}
    show_ranking({"candidates": ranked}, 3)
    told = [line.strip() for line in capfd.readouterr().out.splitlines()][-2:]
    assert told == [
        "2 is distinguished from the first by 3.7 % of the surface, which was observed",
        "3 cannot be distinguished from the first by the observed surface",
    ]


def searching() -> Answers:
    """A service whose search puts the armchair first."""
    shas = {path.stem: hashlib.sha256(path.read_bytes()).hexdigest() for path in CHAIRS}
    ranking = [
        candidate(shas["armchair"], "refined", 0.02, "ambiguous"),
        candidate(shas["dining-chair"], "coarse", 0.4),
    ]
    return service(verdict="ambiguous", object=shas["armchair"], candidates=ranking, artifacts=[])


def test_a_search_on_a_server_names_the_files(run: Run, serve: Serve) -> None:
    outcome = run(*DEMO, "--server", serve(searching()), "--json", code=4)
    document = json.loads(outcome.stdout)
    assert document["object"] == str(CHAIRS[1])
    assert [one["object"] for one in document["candidates"]] == [str(CHAIRS[1]), str(CHAIRS[0])]


def test_a_library_at_the_server_is_searched_by_its_tags(run: Run, serve: Serve) -> None:
    entries = {"entries": [{"name": "seat", "field": "ab" * 32, "state": "ready"}], "next_page_token": None}
    ranking = [candidate("ab" * 32, "refined", 0.02, "registered")]
    found = service(object="ab" * 32, candidates=ranking)
    arguments = [*DEMO[:2], *DEMO[4:], "--tag", "seat"]
    answers = [json.dumps(entries), json.dumps(entries | {"entries": []})]
    address = serve(lambda method, path: (200, answers.pop(0)) if path == "/library" else found(method, path))
    outcome = run(*arguments, "--server", address, "--json")
    assert json.loads(outcome.stdout)["object"] == "seat", outcome.stderr
    outcome = run(*arguments, "--server", address)
    assert "LIBRARY_EMPTY the library has no entries with the tag 'seat'" in outcome.stderr
