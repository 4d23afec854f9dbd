"""`regnf register` on this machine: exit codes, what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from regnf_cli.register import parse_detection
from regnf_core.errors import InvalidDetectionError
from tests.cli.conftest import DATA, Run
from tests.core.analytic import chair, chair_box, chair_pose, room


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[object]:
    """A registration of quick exact fields, with its detection and truth."""
    truth = chair_pose()
    fields = {"room.safetensors": room(truth), "chair.safetensors": chair()}
    for name in fields:
        (tmp_path / name).touch()
    monkeypatch.setattr("regnf_core.loading.load_field", lambda path: fields[path.name])
    box = chair_box(truth)
    (tmp_path / "box.json").write_text(json.dumps({"centre": box.centre.tolist(), "size": box.size.tolist()}))
    (tmp_path / "truth.json").write_text(json.dumps({"T_object_scene": truth.matrix().tolist()}))
    files = [tmp_path / name for name in ("room.safetensors", "chair.safetensors")]
    return ["register", *files, "--detection", tmp_path / "box.json", "--truth", tmp_path / "truth.json"]


def test_a_registration_ends_with_0_and_leaves_its_files(run: Run, exact: list[object], tmp_path: Path) -> None:
    outcome = run(*exact, "--json", "--output", tmp_path / "new" / "out")
    assert outcome.code == 0, outcome.stderr
    document = json.loads(outcome.stdout)
    assert document["verdict"] == "registered"
    assert document["metrics"]["rotation_error_rad"] < 0.03
    folder = tmp_path / "new" / "out"
    np.testing.assert_allclose(np.load(folder / "transform.npy"), document["T_object_scene"]["matrix"])
    assert {"result.json", "aligned.ply", "preview.png"} <= {path.name for path in folder.iterdir()}
    assert all(path.is_file() for path in folder.iterdir())  # nothing half done is left


def test_a_rejected_registration_ends_with_1(run: Run, exact: list[object], tmp_path: Path) -> None:
    (tmp_path / "options.json").write_text('{"optimisation": {"iterations": 1}}')
    far = {"T_object_scene": {"matrix": np.eye(4).tolist()}}
    (tmp_path / "truth.json").write_text(json.dumps(far))  # as results spell it
    outcome = run(*exact, "--options", tmp_path / "options.json")
    assert outcome.code == 1, outcome.stderr
    assert outcome.stdout.startswith("verdict      rejected")
    assert "rotation_error_rad" in outcome.stdout


@pytest.mark.parametrize(
    ("detection", "said"),
    [
        ("no JSON", "MALFORMED_JSON"),
        ("[1, 2]", "MALFORMED_JSON"),
        ("[" * 100_000, "MALFORMED_JSON"),
        ("{}", "INVALID_DETECTION detection lacks 'centre'"),
        ('{"min": [0, 0, 0]}', "INVALID_DETECTION detection lacks 'max'"),
        ('{"max": [0, 0, 0]}', "INVALID_DETECTION detection lacks 'min'"),
        ('{"centre": [0, 0, 0], "size": [1, 1, 1], "colour": 3}', "INVALID_DETECTION detection holds unknown"),
        ('{"centre": [5, 5, 5], "size": [1, 1, 1]}', "DETECTION_OUTSIDE_SCENE"),
        ('{"centre": [0, 0, 0.9], "size": [1e-9, 1e-9, 1e-9]}', "NO_SURFACE_IN_DETECTION"),
    ],
)
def test_detections_that_are_refused(detection: str, said: str, run: Run, exact: list[object], tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text(detection)
    outcome = run(*exact)
    assert outcome.code == 2
    assert said in outcome.stderr
    assert outcome.stdout == ""


@pytest.mark.parametrize(
    "values",
    [
        {"min": [0], "max": [1, 1, 1]},
        {"min": [0, 0, 0], "max": [1, 1, 1], "centre": [0, 0, 0]},
        {"min": [1, 1, 1], "max": [0, 0, 0]},
        {"centre": [0, 0, "a"], "size": [1, 1, 1]},
        {"centre": {"x": 1}, "size": [1, 1, 1]},
        {"centre": [10**400, 0, 0], "size": [1, 1, 1]},
        {"centre": [0, 0, 0], "size": [1, 1, 0]},
        {"centre": [0, 0, 0], "size": [1, 1, 1], "score": "high"},
        {"centre": [0, 0, 0], "size": [1, 1, 1], "rotation_quaternion_xyzw": [0, 0, 0, 0]},
    ],
)
def test_boxes_that_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(InvalidDetectionError):
        parse_detection(values)


@pytest.mark.parametrize("truth", ["{}", '{"T_object_scene": {"scale": 2}}', '{"T_object_scene": [[1, 2], [3]]}'])
def test_a_truth_without_a_transform_is_refused(truth: str, run: Run, exact: list[object], tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text(truth)
    outcome = run(*exact)
    assert outcome.code == 2
    assert outcome.stderr.startswith("INVALID_TRANSFORM ")


def test_options_that_are_refused(run: Run, demo: list[object], tmp_path: Path) -> None:
    (tmp_path / "options.json").write_text('{"sampling": {"views": 0}}')
    outcome = run(*demo, "--options", tmp_path / "options.json")
    assert outcome.code == 2
    assert outcome.stderr.startswith("INVALID_OPTIONS options.sampling.views: ")
    assert outcome.stderr.count("\n") == 1  # one line, however narrow the terminal


@pytest.mark.parametrize("option", ["--options", "--truth", "--detection"])
def test_folders_and_absent_files_are_refused(option: str, run: Run, demo: list[object], tmp_path: Path) -> None:
    assert run(*demo, option, tmp_path).code == 2
    assert run(*demo, option, tmp_path / "absent.json").code == 2


def test_a_folder_is_no_field(run: Run, tmp_path: Path) -> None:
    assert run("register", tmp_path, DATA / "armchair.safetensors", "--detection", DATA / "detection.json").code == 2
    assert run("inspect", tmp_path).code == 2


def test_an_output_below_a_file_is_refused_before_the_work(run: Run, demo: list[object], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert run(*demo, "--output", tmp_path / "file").code == 2
    outcome = run(*demo, "--output", tmp_path / "file" / "out")
    assert outcome.code == 2
    assert outcome.stderr.startswith("FILE_UNUSABLE ")
