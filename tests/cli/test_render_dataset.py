"""``regnf render-dataset``: a folder of images, or a reason and nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from regnf_data.sdfstudio import METADATA, load_dataset
from tests.cli.conftest import Run
from tests.data.rooms import write_room

SMALL = ("--width", 32, "--height", 24)


def test_a_mesh_becomes_a_dataset(run: Run, tmp_path: Path) -> None:
    write_room(tmp_path)
    outcome = run(
        "render-dataset", tmp_path / "chest.ply", tmp_path / "out", "--frames", 4, *SMALL, "--units-per-meter", 2
    )
    assert outcome.code == 0, outcome.stderr
    assert "4 images of chest" in outcome.stdout
    images = load_dataset(tmp_path / "out")
    assert (len(images), images.size) == (4, (24, 32))
    np.testing.assert_allclose(images.instances[0].box.size, [1.2, 0.8, 1.0], atol=1e-6)
    metadata = json.loads((tmp_path / "out" / METADATA).read_text())
    assert metadata["camera_model"] == "OPENCV"
    assert metadata["has_sensor_depth"] is metadata["has_foreground_mask"] is True
    assert {"box_min", "box_max", "box_corners", "world_pose", "gt_pose"} <= set(metadata["instances"][0])


def test_a_layout_becomes_a_dataset(run: Run, tmp_path: Path) -> None:
    layout = write_room(tmp_path)
    given = ("--meshes", tmp_path, "--trajectory", "single", "--instance", "b", "--no-noise", *SMALL)
    outcome = run("render-dataset", layout, tmp_path / "out", *given)
    assert outcome.code == 0, outcome.stderr
    images = load_dataset(tmp_path / "out")
    assert [instance.label for instance in images.instances] == ["b"]
    assert images.masks is None
    assert (tmp_path / "out" / "000000_rgb.png").is_file()


@pytest.mark.parametrize(
    ("source", "more", "reason"),
    [
        ("chest.ply", ["--units-per-meter", "0"], "INVALID_OPTIONS"),
        ("chest.ply", ["--units-per-meter", "nan"], "INVALID_OPTIONS"),
        ("chest.ply", ["--units-per-meter", "1e308"], "INVALID_OPTIONS"),
        ("chest.ply", ["--instance", "a"], "INVALID_OPTIONS"),
        ("chest.ply", ["--meshes", "."], "INVALID_OPTIONS"),
        ("chest.ply", ["--trajectory", "single", "--frames", "2"], "DATASET_FRAMES_INVALID"),
        ("broken.glb", [], "MESH_INVALID"),
        ("point.obj", [], "MESH_INVALID"),
        ("room.json", [], "INVALID_OPTIONS"),
        ("room.json", ["--meshes", ".", "--trajectory", "single"], "INVALID_OPTIONS"),
        ("room.json", ["--meshes", ".", "--instance", "a"], "INVALID_OPTIONS"),
        ("room.json", ["--meshes", ".", "--trajectory", "single", "--instance", "z"], "DATASET_NO_INSTANCE"),
        ("room.json", ["--meshes", "empty"], "DATASET_MESH_MISSING"),
        ("broken.json", ["--meshes", "."], "DATASET_LAYOUT_INVALID"),
    ],
)
def test_refused(
    source: str, more: list[str], reason: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_room(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    before = sorted(tmp_path.iterdir())
    outcome = run("render-dataset", tmp_path / source, tmp_path / "out", *SMALL, *more)
    assert outcome.code == 2
    assert f"\n{reason} " in f"\n{outcome.stderr}"
    assert "Traceback" not in outcome.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_in_use_is_refused_before_the_work(run: Run, tmp_path: Path) -> None:
    write_room(tmp_path)
    outcome = run("render-dataset", tmp_path / "chest.ply", tmp_path)
    assert outcome.code == 2
    assert outcome.stderr.startswith("DATASET_FOLDER_NOT_EMPTY ")
    outcome = run("render-dataset", tmp_path / "chest.ply", tmp_path / "absent" / "out")
    assert outcome.stderr.startswith("DATASET_FOLDER_MISSING ")
