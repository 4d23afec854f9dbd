"""The comparison of a GPU with the CPU: what it says without a GPU, and a small run of it on the CPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.gpu import __main__ as command
from benchmarks.gpu import sections
from benchmarks.gpu.deadline import Deadline
from benchmarks.gpu.pairs import Pair, demo_pairs
from benchmarks.gpu.report import Report, Section
from regnf_core import RegistrationOptions
from regnf_core.errors import InvalidInputError

QUICK = RegistrationOptions.from_dict(
    {"up_axis": "z", "robust": {"rotations": 240, "feature_draws": 0, "scene_samples": 1200, "object_samples": 600}}
)
CPU = torch.device("cpu")


@pytest.fixture
def one_pair(monkeypatch: pytest.MonkeyPatch) -> Pair:
    """Only the demo's first pair, with few samples."""
    pair = demo_pairs()[0]
    monkeypatch.setattr(command, "demo_pairs", lambda: [pair])
    monkeypatch.setattr(sections, "ALONE", QUICK)
    monkeypatch.setattr(sections, "POINTS", 2000)
    monkeypatch.setattr(sections, "ORDER_PAIRS", 2)
    return pair


def test_without_a_gpu_it_says_so_in_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert command.main([]) == command.NO_DEVICE == 3
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "no CUDA device" in said.err


@pytest.mark.timeout(900)
@pytest.mark.long
def test_everything_runs_on_the_cpu(one_pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "gpu.md"
    arguments = ["--device", "cpu", "--seeds", "1", "--repeats", "1", "--batches", "1", "--output", str(output)]
    assert command.main(arguments) == 0
    text = output.read_text(encoding="utf-8")
    assert capsys.readouterr().out == text
    assert f"python -m benchmarks.gpu --device cpu --seeds 1 --repeats 1 --batches 1 --output {output}" in text
    titles = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    assert titles == ["Evaluator", "One registration", "Batches", "Pairs in another company", "Beside the CPU"]
    assert "| 3 | 3 | 0.0e+00 |" in text
    assert f"| {one_pair.name} | 0 | registered | registered | registered | 0.0e+00 |" in text


def test_what_there_is_no_time_for_is_named(one_pair: Pair) -> None:
    over = Deadline(-1.0)
    assert "16 pairs" in sections.batches([one_pair], CPU, [16], over).notes[0]
    assert "1 of 1 pairs" in sections.correctness([one_pair], CPU, 1, over).notes[-1]
    assert sections.order([one_pair], CPU, over).notes == ["Left out for want of time."]


def test_another_verdict_is_not_the_cpus_result(one_pair: Pair) -> None:
    broken = InvalidInputError("broken", reason="FIELD_NOT_FINITE")
    row, same = sections.compared(one_pair, 0, broken, [broken, None])
    assert not same
    assert row[-1] == "NO"
    assert sections.compared(one_pair, 0, broken, [broken, broken])[1]
    report = Report("# Title", [Section("One", ("a",), [["1"]]), Section("Two", ("a",), [["2"]], met=False)])
    assert not report.met
    assert report.text() == "# Title\n\n## One\n\n| a |\n|---|\n| 1 |\n\n## Two\n\n| a |\n|---|\n| 2 |"
