"""`regnf batch`: a file of pairs, and results that a second run adds to."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
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


@pytest.mark.parametrize("member", ["initial_transform", "ground_truth"])
def test_a_pose_may_be_said_in_either_direction(folder: Path, member: str) -> None:
    into_scene = [[0.5, 0, 0, 1], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]]
    into_object = [[2.0, 0.0, 0.0, -2.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    (folder / "pose.json").write_text(json.dumps({"T_scene_object": into_scene}))
    said = [into_object, {"T_object_scene": {"matrix": into_object}}, {"T_scene_object": into_scene}, "pose.json"]
    path = write(folder, [pair(**{member: one}) for one in (*said, [1, 2])])
    *read, wrong = read_pairs(path)
    meant = into_object if member == "initial_transform" else {"T_object_scene": into_object}
    assert [one.request[member] if one.request else one.error for one in read] == [meant] * len(said)
    assert wrong.error is not None
    assert wrong.error.reason == "INVALID_TRANSFORM"


@pytest.mark.parametrize(
    ("member", "value", "reason"),
    [
        (
            "initial_transform",
            [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            "PRESET_UNSUITABLE",
        ),
        (
            "ground_truth",
            {"T_object_scene": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
            "INVALID_REQUEST",
        ),
    ],
)
def test_a_search_refuses_what_is_of_one_object(
    run: Run, folder: Path, member: str, value: object, reason: str
) -> None:
    """As a service does; nothing that is given is passed over."""
    path = write(folder, [pair(object=None, candidates=["armchair.safetensors"], **{member: value})])
    assert run("batch", str(path), "--processes", "1").code == 1
    assert [one["error"]["reason"] for one in results(path)] == [reason]


def test_results_are_beside_the_pairs_failures_apart(run: Run, folder: Path) -> None:
    lines: list[dict[str, Any] | str] = [
        pair(key="a"),
        pair(key="far", detection={"min": [50, 50, 50], "max": [51, 51, 51]}),
        "{nothing",
        pair(key="nowhere", object="nothing.ckpt"),
        pair(key="search", object=None, candidates=["dining-chair.safetensors", "armchair.safetensors"]),
    ]
    path = write(folder, lines)
    outcome = run("batch", path, "--processes", 1)
    assert outcome.code == 1, outcome.stderr
    found = {one["line"]: one for one in results(path)}
    reasons = {line: one["error"]["reason"] for line, one in found.items() if one["status"] == "failed"}
    assert reasons == {2: "DETECTION_OUTSIDE_SCENE", 3: "MALFORMED_JSON", 4: "FILE_NOT_FOUND"}
    assert found[1]["verdict"] in ("registered", "ambiguous", "rejected")
    assert len(found[1]["T_object_scene"]["matrix"]) == len(found[1]["T_scene_object"]["matrix"]) == 4
    assert found[1]["probability"] == found[1]["metrics"]["probability"]
    assert found[1]["metrics"]["seconds"] > 0
    assert Path(found[5]["object"]).name == "armchair.safetensors"
    assert "3 failed" in outcome.stdout


def test_a_second_run_does_what_is_left(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []

    def pretend(one: FilePair) -> dict[str, Any]:
        done.append(one.line)
        return (
            {"status": "failed", "error": {"reason": "X", "detail": "x"}}
            if one.key == "bad"
            else {"status": "successful"}
        )

    monkeypatch.setattr(batch_here, "register_pair", pretend)
    path = write(folder, [pair(seed=1), pair(seed=2, key="bad")])
    assert run("batch", path, "--processes", 1).code == 1
    write(folder, [pair(seed=1), pair(seed=2, key="bad"), pair(seed=3)])
    with path.with_suffix(".results.jsonl").open("a") as file:
        file.write('{"id": "torn')
    assert run("batch", path, "--processes", 1).code == 1
    assert done == [1, 2, 2, 3]
    assert len(results(path)) == 4
    write(folder, [pair(seed=3), pair(seed=1)])
    assert run("batch", path, "--processes", 1).code == 0
    assert done == [1, 2, 2, 3], "both were done, wherever they stand now"


def test_a_file_that_holds_no_results_is_left_as_it_is(run: Run, folder: Path) -> None:
    path = write(folder, [pair()])
    other = folder / "notes.txt"
    for held in (b"not mine\n", b"not mine", b"\xa0\0\n\xff", b'{"id": "a", "status": "successful"}\nmine'):
        other.write_bytes(held)
        outcome = run("batch", path, "--output", other)
        assert (outcome.code, "RESULTS_UNREADABLE" in outcome.stderr) == (2, True)
        assert other.read_bytes() == held
    path.write_text(path.read_text().rstrip("\n"))
    before = path.read_bytes()
    assert run("batch", path, "--output", path).code == 2
    assert path.read_bytes() == before


def test_a_table_is_read_too(folder: Path) -> None:
    path = folder / "pairs.csv"
    with path.open("w", newline="") as file:
        rows = csv.DictWriter(file, ["key", "scene", "object", "detection", "seed"])
        rows.writeheader()
        rows.writerow({"key": "a", **pair(options=None), "seed": 7})
        rows.writerow({"key": "b", **pair(options=None)})
    first, second = read_pairs(path)
    assert (first.key, first.line, first.scene) == ("a", 2, str(folder / "mix-room.safetensors"))
    assert (first.request or {})["seed"] == 7
    assert (second.request or {})["seed"] == 0
    box = json.loads((folder / "detection.json").read_text())
    assert (first.request or {})["detection"]["center"] == pytest.approx(box["center"])


def test_what_is_no_pair_says_why(folder: Path) -> None:
    lines: list[dict[str, Any] | str] = [
        "7",
        pair(detections=[]),
        pair(object=None),
        pair(candidates=["armchair.safetensors"]),
        pair(seed=-1),
        pair(options={"robust": {"rotation": 3}}),
        pair(detection="nothing.json"),
        pair(object=7),
    ]
    found = list(read_pairs(write(folder, lines)))
    assert [one.error and one.error.reason for one in found] == [
        "INVALID_REQUEST", "INVALID_REQUEST", "INVALID_REQUEST", "INVALID_REQUEST", "INVALID_REQUEST",
        "INVALID_OPTIONS", "FILE_NOT_FOUND", "INVALID_REQUEST",
    ]  # fmt: skip
    assert found[1].error is not None
    assert "detection" in (found[1].error.hint or "")


def test_several_processes_find_the_same(folder: Path) -> None:
    pairs = list(read_pairs(write(folder, [pair(seed=seed) for seed in range(2)])))
    alone = {one.line: told["T_object_scene"] for one, told in register_here(pairs, 1)}
    together = {one.line: told["T_object_scene"] for one, told in register_here(pairs, 2)}
    assert together == alone


def test_results_of_a_batch_at_a_service(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import regnf_client
    from regnf_client import PairResult

    class Pretended:
        def __init__(self, *_: object, **__: object) -> None: ...
        def __enter__(self) -> Pretended:
            return self

        def __exit__(self, *_: object) -> None: ...

        def batch(self, requests: Iterator[Any]) -> Iterator[PairResult]:
            for index, one in enumerate(requests):
                assert one.more["pictures"] is (one.seed == 3)  # as the file says, else none
                told = {"status": "successful", "verdict": "registered", "job": f"job {one.seed}"}
                matrix = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
                back = [[0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1]]
                poses = {"T_scene_object": back, "T_object_scene": matrix, "probability": 0.9}
                yield PairResult.model_validate({"index": index, **poses, **told})

    monkeypatch.setattr(regnf_client, "Client", Pretended)
    path = write(folder, [pair(seed=1, key="a"), "no pair", pair(seed=3, key="c", pictures=True)])
    assert run("batch", path, "--server", "http://localhost:1").code == 1
    found = {one["line"]: one for one in results(path)}
    assert (found[1]["job"], found[3]["job"], found[2]["status"]) == ("job 1", "job 3", "failed")
    assert found[3]["T_object_scene"]["scale"] == pytest.approx(2.0)
    assert found[3]["T_scene_object"]["scale"] == pytest.approx(0.5)
    assert found[3]["probability"] == 0.9
    assert found[3]["key"] == "c"


def test_a_torn_line_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    path.write_text('{"id": "a", "status": "successful"}\n' + '{"id": "b", "note": "' + "x" * 10_000)
    ResultsFile(path)
    assert path.read_text() == '{"id": "a", "status": "successful"}\n'
    for torn in ("", "{", '{"id": "b'):
        path.write_text(torn)
        ResultsFile(path)
        assert path.read_text() == ""
