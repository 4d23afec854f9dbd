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
        "render-dataset",
        tmp_path / "chest.ply",
        tmp_path / "out",
        "--frames",
        4,
        *SMALL,
        "--units-per-meter",
        2,
        code=0,
    )
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
    run("render-dataset", layout, tmp_path / "out", *given, code=0)
    images = load_dataset(tmp_path / "out")
    assert [instance.label for instance in images.instances] == ["b"]
    assert images.masks is None
    assert (tmp_path / "out" / "000000_rgb.png").is_file()


MESHES, SINGLE = ["--meshes", "."], ["--trajectory", "single"]
REFUSED: list[tuple[str, str, list[str], str]] = [
    *[("chest.ply", "out", ["--units-per-meter", said], "INVALID_OPTIONS") for said in ("0", "nan", "1e308")],
    ("chest.ply", "out", ["--instance", "a"], "INVALID_OPTIONS"),
    ("chest.ply", "out", MESHES, "INVALID_OPTIONS"),
    ("chest.ply", "out", [*SINGLE, "--frames", "2"], "DATASET_FRAMES_INVALID"),
    ("chest.ply", ".", [], "DATASET_FOLDER_NOT_EMPTY"),
    ("chest.ply", "absent/out", [], "DATASET_FOLDER_MISSING"),
    ("broken.glb", "out", [], "MESH_INVALID"),
    ("point.obj", "out", [], "MESH_INVALID"),
    ("room.json", "out", [], "INVALID_OPTIONS"),
    ("room.json", "out", [*MESHES, *SINGLE], "INVALID_OPTIONS"),
    ("room.json", "out", [*MESHES, "--instance", "a"], "INVALID_OPTIONS"),
    ("room.json", "out", [*MESHES, *SINGLE, "--instance", "z"], "DATASET_NO_INSTANCE"),
    ("room.json", "out", ["--meshes", "empty"], "DATASET_MESH_MISSING"),
    ("broken.json", "out", MESHES, "DATASET_LAYOUT_INVALID"),
]


def test_refused_before_the_work(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_room(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.glb").write_bytes(b"glTF")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    before = sorted(tmp_path.iterdir())
    for source, output, more, reason in REFUSED:
        outcome = run("render-dataset", tmp_path / source, tmp_path / output, *SMALL, *more)
        assert (outcome.code, f"\n{reason} " in f"\n{outcome.stderr}") == (2, True), (source, more, outcome.stderr)
        assert "Traceback" not in outcome.stderr
        assert sorted(tmp_path.iterdir()) == before
