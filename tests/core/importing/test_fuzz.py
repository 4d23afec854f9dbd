"""Whatever the bytes: success or FieldFormatError, never another exception."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.core.importing.fuzzing.cases import STAGES, make_case
from tests.core.importing.fuzzing.seeds import Seeds, make_seeds
from tests.core.importing.fuzzing.stages import run_stage
from tests.core.importing.fuzzing.worker import ENVIRONMENT

ROOT = Path(__file__).resolve().parents[3]
CASES = 4_500


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    return make_seeds(tmp_path_factory.mktemp("seeds"))


@pytest.fixture(scope="module")
def fuzzed(seeds: Seeds, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the fuzzing process makes of the cases that `python -m benchmarks.fuzz_gate` begins with."""
    folder = tmp_path_factory.mktemp("fuzz")
    seeds.save(folder / "seeds")
    module, places = "tests.core.importing.fuzzing.worker", (str(folder / "seeds"), str(folder))
    command = [sys.executable, "-m", module, *places, "1.1", str(folder / "corpus"), *STAGES]
    asked, environment = f"0 {CASES}\n", os.environ | ENVIRONMENT
    done = subprocess.run(command, input=asked, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stderr} at {(folder / 'case').read_bytes()!r:.300}"
    results: dict[str, Any] = json.loads(done.stdout)
    return results


@pytest.mark.long
@pytest.mark.timeout(900)
def test_no_invented_file_is_more_than_refused(fuzzed: dict[str, Any]) -> None:
    """No other exception, no import, no file left or opened, nothing slow, nothing large."""
    assert [(failure["at"], failure["fault"]) for failure in fuzzed["failures"]] == []
    assert sum(fuzzed["outcomes"].values()) == CASES


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_fuzzer_reaches_what_lies_deep(fuzzed: dict[str, Any]) -> None:
    """A fuzzer whose cases all fail at the first check would find nothing."""
    outcomes = fuzzed["outcomes"]
    assert all(outcomes[f"{stage} taken"] > 10 for stage in STAGES)
    deep = ("ARCHIVE_CRC_MISMATCH", "TENSOR_NOT_DENSE", "TENSOR_NOT_FINITE", "TENSOR_STORAGE_MISMATCH", "TENSOR_SHAPE")
    assert all(any(key.endswith(reason) for key in outcomes) for reason in deep)
    assert len({key.split()[1] for key in outcomes}) > 40
    assert fuzzed["finds"] > 50


def test_every_sound_file_is_taken(seeds: Seeds, tmp_path: Path) -> None:
    """What is refused undamaged would never get deeper damaged."""
    files = {"checkpoint": seeds.archive, "field file": seeds.field_file, **seeds.other_files}
    ended = {
        kind: run_stage("settings" if kind.startswith("settings ") else "file", data, tmp_path)
        for kind, data in files.items()
    }
    assert ended == dict.fromkeys(files, "taken")


@pytest.mark.parametrize("stage", STAGES)
def test_a_seed_gives_the_same_cases_again_and_each_is_taken_or_refused(
    seeds: Seeds, stage: str, tmp_path: Path
) -> None:
    first, second = ([make_case(Random(i), stage, seeds, []) for i in range(30)] for _ in range(2))
    assert first == second
    assert len(set(first)) > 18
    outcomes = {run_stage(stage, case, tmp_path) for case in first}
    assert len(outcomes) > 1
    assert all(outcome == "taken" or outcome.isupper() for outcome in outcomes)


WATCHED = """
import sys
from tests.core.importing.fuzzing.stages import Watch
watch = Watch()
with watch.over("pickle"):
    {action}
print("heard" if watch.events else "silent")
"""


@pytest.mark.parametrize(
    ("action", "heard"),
    [
        ("import this_is_no_module_of_ours", "heard"),
        ("__import__('os').system('true')", "heard"),
        ("open('/dev/null')", "heard"),
        ("eval('1')", "heard"),
        ("__import__('socket').socket()", "heard"),
        ("sorted([3, 1, 2])", "silent"),
    ],
)
def test_the_watch_hears_what_a_file_must_not_bring_about(action: str, heard: str) -> None:
    action = f"try: {action}\n    except ImportError: pass"
    program = WATCHED.format(action=action)
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == heard, done.stderr
