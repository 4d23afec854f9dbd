"""`regnf batch`: a file of pairs, and results that a second run adds to."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from regnf_cli import batch as batch_here
from regnf_cli.batch import register_here
from regnf_cli.batch_file import FilePair, ResultsFile, read_pairs
from tests.cli.conftest import DATA, Run

QUICK = {"up_axis": "z", "robust": {"rotations": 24, "feature_draws": 0, "scene_samples": 500, "object_samples": 500}}


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Fields and a detection beside the pairs."""
    made = tmp_path / "pairs"
    made.mkdir()
    for name in ("mix-room.safetensors", "armchair.safetensors", "dining-chair.safetensors", "detection.json"):
        shutil.copy(DATA / name, made / name)
    return made


def pair(**changes: Any) -> dict[str, Any]:
    usual = {"scene": "mix-room.safetensors", "object": "armchair.safetensors", "detection": "detection.json"}
    return {name: value for name, value in (usual | {"options": QUICK} | changes).items() if value is not None}


def write(folder: Path, lines: list[dict[str, Any] | str]) -> Path:
    path = folder / "pairs.jsonl"
    path.write_text("".join((one if isinstance(one, str) else json.dumps(one)) + "\n" for one in lines))
    return path


def results(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.with_suffix(".results.jsonl").read_text().splitlines()]


def test_results_are_beside_the_pairs_failures_apart(run: Run, folder: Path) -> None:
    lines: list[dict[str, Any] | str] = [
        pair(key="a"),
        pair(key="far", detection={"min": [50, 50, 50], "max": [51, 51, 51]}),
        "{nothing",
        pair(key="nowhere", object="nothing.ckpt"),
        pair(key="search", object=None, candidates=["dining-chair.safetensors", "armchair.safetensors"]),
    ]
    path = write(folder, lines)
    outcome = run("batch", path, "--processes", 1, code=1)
    found = {one["line"]: one for one in results(path)}
    reasons = {line: one["error"]["reason"] for line, one in found.items() if one["status"] == "failed"}
    assert reasons == {2: "DETECTION_OUTSIDE_SCENE", 3: "MALFORMED_JSON", 4: "FILE_NOT_FOUND"}
    assert found[1]["verdict"] in ("registered", "ambiguous", "rejected")
    assert len(found[1]["T_object_scene"]["matrix"]) == len(found[1]["T_scene_object"]["matrix"]) == 4
    assert found[1]["probability"] == found[1]["metrics"]["probability"]
    assert found[1]["level"] == "strict"
    assert found[1]["metrics"]["seconds"] > 0
    assert Path(found[5]["object"]).name == "armchair.safetensors"
    assert "3 failed" in outcome.stdout


def test_a_file_that_holds_no_results_is_left_as_it_is(run: Run, folder: Path) -> None:
    path = write(folder, [pair()])
    other = folder / "notes.txt"
    for torn in ("", "{", '{"id": "b'):
        other.write_text(torn)
        ResultsFile(other)
        assert other.read_text() == "", "a first line that is torn is cut off"
    for held in (b"not mine\n", b"not mine", b"\xa0\0\n\xff", b'{"id": "a", "status": "successful"}\nmine'):
        other.write_bytes(held)
        outcome = run("batch", path, "--output", other)
        assert (outcome.code, "RESULTS_UNREADABLE" in outcome.stderr) == (2, True)
        assert other.read_bytes() == held
    path.write_text(path.read_text().rstrip("\n"))
    before = path.read_bytes()
    assert run("batch", path, "--output", path).code == 2
    assert path.read_bytes() == before


UNIT = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
NO_PAIRS: list[tuple[str | dict[str, Any], str]] = [
    ("7", "INVALID_REQUEST"),
    (pair(detections=[]), "INVALID_REQUEST"),
    (pair(object=None), "INVALID_REQUEST"),
    (pair(candidates=["armchair.safetensors"]), "INVALID_REQUEST"),
    (pair(seed=-1), "INVALID_REQUEST"),
    (pair(options={"robust": {"rotation": 3}}), "INVALID_OPTIONS"),
    (pair(detection="nothing.json"), "FILE_NOT_FOUND"),
    (pair(object=7), "INVALID_REQUEST"),
    (pair(initial_transform=[1, 2]), "INVALID_TRANSFORM"),
    (pair(ground_truth=[1, 2]), "INVALID_TRANSFORM"),
]


def test_what_is_no_pair_says_why(folder: Path) -> None:
    found = list(read_pairs(write(folder, [line for line, _ in NO_PAIRS])))
    assert [one.error and one.error.reason for one in found] == [reason for _, reason in NO_PAIRS]
    assert "detection" in ((found[1].error and found[1].error.hint) or "")


@pytest.mark.parametrize("member", ["initial_transform", "ground_truth"])
def test_a_pose_may_be_said_in_either_direction(folder: Path, member: str) -> None:
    into_scene = [[0.5, 0, 0, 1], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]]
    into_object = [[2.0, 0.0, 0.0, -2.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    (folder / "pose.json").write_text(json.dumps({"T_scene_object": into_scene}))
    said = [into_object, {"T_object_scene": {"matrix": into_object}}, {"T_scene_object": into_scene}, "pose.json"]
    read = read_pairs(write(folder, [pair(**{member: one}) for one in said]))
    meant = into_object if member == "initial_transform" else {"T_object_scene": into_object}
    assert [one.request[member] if one.request else one.error for one in read] == [meant] * len(said)


def test_a_search_refuses_what_is_of_one_object(run: Run, folder: Path) -> None:
    """As a service does; nothing that is given is passed over."""
    search = {"object": None, "candidates": ["armchair.safetensors"]}
    wrong = [pair(**search, initial_transform=UNIT), pair(**search, ground_truth={"T_object_scene": UNIT})]
    path = write(folder, wrong)
    assert run("batch", path, "--processes", 1).code == 1
    assert [one["error"]["reason"] for one in results(path)] == ["PRESET_UNSUITABLE", "INVALID_REQUEST"]


def test_a_second_run_does_what_is_left(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    failed = {"status": "failed", "error": {"reason": "X", "detail": "x"}}

    def pretend(one: FilePair) -> dict[str, Any]:
        done.append(one.line)
        return failed if one.key == "bad" else {"status": "successful"}

    monkeypatch.setattr(batch_here, "register_pair", pretend)
    path = write(folder, [pair(seed=1), pair(seed=2, key="bad")])
    assert run("batch", path, "--processes", 1).code == 1
    write(folder, [pair(seed=1), pair(seed=2, key="bad"), pair(seed=3)])
    with path.with_suffix(".results.jsonl").open("a") as file:
        file.write('{"id": "torn' + "x" * 10_000)
    assert run("batch", path, "--processes", 1).code == 1
    assert done == [1, 2, 2, 3]
    assert len(results(path)) == 4
    write(folder, [pair(seed=3), pair(seed=1)])
    assert run("batch", path, "--processes", 1).code == 0
    assert done == [1, 2, 2, 3], "both were done, wherever they stand now"


def test_several_processes_find_the_same(folder: Path) -> None:
    pairs = list(read_pairs(write(folder, [pair(seed=seed) for seed in range(2)])))
    alone = {one.line: told["T_object_scene"] for one, told in register_here(pairs, 1)}
    together = {one.line: told["T_object_scene"] for one, told in register_here(pairs, 2)}
    assert together == alone


def test_results_of_a_batch_at_a_service(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import regnf_client
    from regnf_client import PairResult

    class Pretended(nullcontext[Any]):
        def __init__(self, *_: object, **__: object) -> None:
            super().__init__(self)

        def batch(self, requests: Iterator[Any]) -> Iterator[PairResult]:
            for index, one in enumerate(requests):
                assert one["pictures"] is (one["seed"] == 3)  # as the file says, else none
                told = {"status": "successful", "verdict": "registered", "job": f"job {one['seed']}"}
                matrix = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
                back = [[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]]
                poses = {"T_scene_object": back, "T_object_scene": matrix, "probability": 0.9, "level": "default"}
                yield PairResult.model_validate({"index": index, **poses, **told})

    monkeypatch.setattr(regnf_client, "Client", Pretended)
    path = write(folder, [pair(seed=1, key="a"), "no pair", pair(seed=3, key="c", pictures=True)])
    assert run("batch", path, "--server", "http://localhost:1").code == 1
    found = {one["line"]: one for one in results(path)}
    assert (found[1]["job"], found[3]["job"], found[2]["status"]) == ("job 1", "job 3", "failed")
    assert [found[3][name]["scale"] for name in ("T_object_scene", "T_scene_object")] == pytest.approx([2.0, 0.5])
    assert (found[3]["probability"], found[3]["level"], found[3]["key"]) == (0.9, "default", "c")
