"""`regnf register` on this machine: exit codes, what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_cli.options import read_options
from regnf_cli.report import symmetry_in_words
from regnf_core.errors import VERDICT_REASONS, InvalidOptionsError
from regnf_core.field_notes import NO_NOTES
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.loading import LoadedField
from tests.cli.conftest import Run
from tests.core.analytic import chair, chair_box, chair_pose, room
from tests.core.robust.shapes import slab_table, table_room


def pretended(monkeypatch: pytest.MonkeyPatch, folder: Path, fields: Mapping[str, SdfField]) -> list[Path]:
    """Files that open as these fields."""
    for name in fields:
        (folder / name).write_bytes(bytes(8) + b"{")
    monkeypatch.setattr("regnf_core.loading.safe_field", lambda one: None)
    monkeypatch.setattr("regnf_core.loading.load_field", lambda one: LoadedField(fields[one.file.name], NO_NOTES))
    return [folder / name for name in fields]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[object]:
    """A registration of quick exact fields, with its detection and truth."""
    truth = chair_pose()
    files = pretended(monkeypatch, tmp_path, {"room.safetensors": room(truth), "chair.safetensors": chair()})
    box = chair_box(truth)
    (tmp_path / "box.json").write_text(json.dumps({"center": box.center.tolist(), "size": box.size.tolist()}))
    (tmp_path / "truth.json").write_text(json.dumps({"T_object_scene": truth.matrix().tolist()}))
    return ["register", *files, "--detection", tmp_path / "box.json", "--ground-truth", tmp_path / "truth.json"]


@pytest.fixture
def symmetric(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[object]:
    """A registration of a table that half a turn carries onto itself."""
    truth = Sim3.from_translation(torch.tensor([0.0, 0.0, -0.3], dtype=torch.float64))
    fields = {"room.safetensors": table_room(truth), "table.safetensors": slab_table()}
    (tmp_path / "box.json").write_text('{"min": [-0.48, -0.33, -0.03], "max": [0.48, 0.33, 0.49]}')
    return ["register", *pretended(monkeypatch, tmp_path, fields), "--detection", tmp_path / "box.json"]


def test_a_registration_ends_with_0_and_leaves_its_files(run: Run, exact: list[object], tmp_path: Path) -> None:
    outcome = run(*exact, "--json", "--output", tmp_path / "new" / "out", code=0)
    document = json.loads(outcome.stdout)
    assert document["verdict"] == "registered"
    assert document["metrics"]["rotation_error_rad"] < 0.03
    folder = tmp_path / "new" / "out"
    np.testing.assert_allclose(np.load(folder / "T_scene_object.npy"), document["T_scene_object"]["matrix"])
    assert {"result.json", "aligned.ply", "preview.png"} <= {path.name for path in folder.iterdir()}
    assert all(path.is_file() for path in folder.iterdir())  # nothing half done is left
    assert f"wrote {folder}: result.json, preview.png" in outcome.stderr


def test_a_rejected_registration_ends_with_1(run: Run, exact: list[object], tmp_path: Path) -> None:
    (tmp_path / "options.json").write_text('{"optimization": {"iterations": 1}}')
    far = {"T_scene_object": {"matrix": np.eye(4).tolist()}}
    (tmp_path / "truth.json").write_text(json.dumps(far))  # as results spell it
    outcome = run(*exact, "--preset", "paper", "--options", tmp_path / "options.json", code=1)
    assert outcome.stdout.startswith("verdict      rejected")
    assert "rotation_error_rad" in outcome.stdout


def test_an_ambiguous_registration_ends_with_4_and_lists_the_alternatives(run: Run, symmetric: list[object]) -> None:
    outcome = run(*symmetric, code=4)
    said = outcome.stdout
    assert said.startswith("verdict      ambiguous  (SEVERAL_POSES_AGREE)")
    assert VERDICT_REASONS["SEVERAL_POSES_AGREE"] in said
    assert re.search(
        r"^probability +\d+\.\d % that one of the listed poses is right \((default|strict)\)$", said, flags=re.M
    )
    assert re.search(r"^ *1 +0\.\d{4} +180 degrees about z", said, flags=re.M)
    assert said.index("T_scene_object") < said.index("center")
    assert "T_object_scene" not in said
    assert re.search(r"^center( +-?[\d.]+){3} in the scene, ±( [\d.e-]+){3} scene units$", said, flags=re.M)
    assert re.search(r"^scale +[\d.]+ object units per scene unit, ± [\d.e-]+ %$", said, flags=re.M)
    assert re.search(r"^rotation +±( [\d.e-]+){3} degrees about the object's x, y, z$", said, flags=re.M)
    assert re.search(r"^symmetry +2 rotations about z of the object look the same", said, flags=re.M)


@pytest.mark.parametrize(
    ("symmetry", "said"),
    [
        ({"order": 1, "axis": None, "continuous": False}, "none"),
        ({"order": 4, "axis": None, "continuous": False}, "4 rotations look the same, including the identity"),
        ({"order": 1, "axis": [0, 0, 1], "continuous": True}, "any rotation about z of the object"),
        ({"order": 2, "axis": [1, 0, 0], "continuous": True}, "any rotation about x of the object, and"),
    ],
)
def test_symmetries_in_words(symmetry: dict[str, object], said: str) -> None:
    assert symmetry_in_words(symmetry).startswith(said)


def test_a_given_start(run: Run, exact: list[object], tmp_path: Path) -> None:
    near = chair_pose().matrix()
    near[0, 3] += 0.02
    (tmp_path / "start.json").write_text(json.dumps({"T_object_scene": {"matrix": near.tolist()}}))
    outcome = run(*exact, "--json", "--initial-transform", tmp_path / "start.json", code=0)
    assert json.loads(outcome.stdout)["metrics"]["rotation_error_rad"] < 0.01
    (tmp_path / "start.json").write_text(json.dumps(np.eye(4).tolist()))
    outcome = run(*exact, "--preset", "paper", "--initial-transform", tmp_path / "start.json", code=2)
    assert outcome.stderr.startswith("PRESET_UNSUITABLE ")


NO_TRANSFORMS = (
    "{}", '{"T_object_scene": {"scale": 2}}', '{"T_object_scene": null}', "[[1, 2], [3]]", '"abcd"', "7",
    "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]",
    "[[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
)  # fmt: skip


@pytest.mark.parametrize("option", ["--initial-transform", "--ground-truth"])
def test_a_file_without_a_transform_is_refused(option: str, run: Run, exact: list[object], tmp_path: Path) -> None:
    for text in NO_TRANSFORMS:
        (tmp_path / "T.json").write_text(text)
        outcome = run(*exact, option, tmp_path / "T.json")
        assert (outcome.code, outcome.stderr.partition(" ")[0]) == (2, "INVALID_TRANSFORM"), text


def test_the_file_names_the_preset_unless_two_are_named(tmp_path: Path) -> None:
    file = tmp_path / "options.json"
    file.write_text('{"preset": "paper"}')
    assert read_options(file, None) == read_options(file, "paper") == {"preset": "paper"}
    assert read_options(None, "paper") == {"preset": "paper"}
    assert read_options(None, None) == {}
    with pytest.raises(InvalidOptionsError, match="has 'paper', and --preset is robust"):
        read_options(file, "robust")


def test_a_box_of_air_is_refused(run: Run, exact: list[object], tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text('{"center": [0, 0, 0.9], "size": [1e-9, 1e-9, 1e-9]}')
    outcome = run(*exact)
    assert (outcome.code, outcome.stdout, "NO_SURFACE_IN_DETECTION" in outcome.stderr) == (2, "", True)
