"""The figures of the release: which steps run, and that two programs count the same."""

from __future__ import annotations

import argparse
import gzip
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import release, release_steps
from benchmarks.worlds.__main__ import _parser
from regnf_core.version import ENGINE_REVISION

Given = Callable[..., argparse.Namespace]
ROW = {"revision": ENGINE_REVISION, "others": [], "moved": [0.0], "same": [1.0], "question": "right"}


@pytest.fixture
def given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Given:
    """Options of `run` whose results and work lie in a folder of the test."""
    for module in (release, release_steps):
        monkeypatch.setattr(module, "RESULTS", tmp_path / "results")
    (tmp_path / "results" / "worlds").mkdir(parents=True)
    parser = argparse.ArgumentParser()
    release_steps.add_options(parser)
    return lambda *options: parser.parse_args([*options, "--work", str(tmp_path / "work")])


def test_what_is_measured_or_lacks_data_is_left_out(given: Given, capsys: pytest.CaptureFixture[str]) -> None:
    release_steps._write_runs(release.TIME, [{"revision": ENGINE_REVISION, "case": "small", "seconds": 1.0}])
    release_steps.run(given("--only", "time", "bop", "exact", "--rooms", "rooms"))
    assert capsys.readouterr().out.splitlines() == [
        f"time: done, engine revision {ENGINE_REVISION}",
        "bop: left out, it needs --bop",
        "exact: left out, it needs --meshes",
    ]
    release_steps._write_runs(release.TIME, [{"revision": ENGINE_REVISION - 1, "case": "small", "seconds": 1.0}])
    assert not release_steps.STEPS["time"].done


def test_worlds_are_asked_again_only_for_what_is_missing(
    given: Given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def command(module: str, *arguments: object) -> None:
        found = _parser().parse_args([str(one) for one in arguments])  # a command that exists
        if found.command == "evidence":
            if len(asked) == 3:
                asked.append("interrupted")
                raise KeyboardInterrupt
            asked.append(f"{found.scene} {found.observed_by} {found.known_scale}")
            found.output.write_text(json.dumps(ROW) + "\n")
        elif found.command == "trust":
            (tmp_path / "work" / "reliability-all.svg").write_text("")

    monkeypatch.setattr(release_steps, "_command", command)
    monkeypatch.setattr(release_steps.shutil, "copy", lambda *paths: None)
    options = given("--only", "worlds", "--meshes", "objects", "furniture")
    with pytest.raises(KeyboardInterrupt):
        release_steps.run(options)
    release_steps.run(options)
    assert asked == [
        *("rendered images None", "tsdf images None", "rendered nothing None", "interrupted"),
        *("rendered recording 0.01", "tsdf recording 0.01"),
    ]
    lines = gzip.decompress((tmp_path / "results" / release.WORLDS).read_bytes()).decode().splitlines()
    assert [json.loads(line) for line in lines] == [{"revision": ENGINE_REVISION, "question": "right"}] * 5
    assert release_steps.STEPS["worlds"].done


def test_the_worlds_figures_are_those_of_their_own_table() -> None:
    text = (release.RESULTS / "worlds" / "trust.md").read_text()
    cells = [cell.strip() for cell in re.findall(r"\| \*\*all\*\* \|.*", text)[0].split("|")]
    (row, strict) = [row.figures for name in ("all", "strict") for row in release.rows() if row.id == f"right/{name}"]
    counted = [re.sub(r" \(.*", "", cell) for cell in cells if " of " in cell]
    shown = [row["correct pose"], *(one[name] for one in (row, strict) for name in list(row)[1:])]
    assert [figure.partition(" (")[0] for figure in shown] == counted
