"""Recordings as scenes: by Python and by the command line, from images to a pose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import regnf
from regnf_core.errors import InvalidDetectionError
from regnf_core.geometry.box import OrientedBox
from tests.cli.conftest import Run
from tests.frames import CAMERA, K, error_m, model, shots, write_frame, write_mask, write_model

SHOT = shots()[0]
K_FILE = K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
NEAR_M = 0.003
"""A pixel is 3 mm wide on the thing."""


@pytest.mark.parametrize("kind", ["mask", "box", "point", "no color", "millimeters"])
def test_a_thing_in_a_depth_image_is_found(kind: str, tmp_path: Path) -> None:
    rows, columns = np.nonzero(SHOT.mask)
    point = [float(np.median(columns)), float(np.median(rows))]
    detection = {"box": {"box_2d": SHOT.box_2d}, "point": {"point_2d": point}}.get(kind)
    mask = SHOT.mask if detection is None else None
    depth = np.round(SHOT.depth * 1000).astype(np.uint16) if kind == "millimeters" else SHOT.depth
    frame = regnf.Frame(depth, K_FILE, mask=mask, color=None if kind == "no color" else SHOT.color)
    result = regnf.register(frame, write_model(tmp_path), detection, clouds=False)
    assert result.verdict == "registered"
    assert result.camera is not None
    assert result.camera.object_unit == 0.001
    assert result.T_camera_object is not None
    assert error_m(result.T_camera_object.matrix(), SHOT.T_camera_object) < NEAR_M
    assert result.to_dict()["camera"]["frame"] == "0"


def test_several_frames_and_a_box_in_their_world(tmp_path: Path) -> None:
    taken = shots(3)
    frames = [regnf.Frame(s.depth, K_FILE, T_world_camera=s.T_world_camera, name=f"f{n}") for n, s in enumerate(taken)]
    corners = np.asarray(model().vertices) @ taken[0].T_world_object[:3, :3].T + taken[0].T_world_object[:3, 3]
    box = OrientedBox.from_corners(corners.min(axis=0) - 0.01, corners.max(axis=0) + 0.01)
    mask = {"frame": "f1", "mask": taken[1].mask}
    path = write_model(tmp_path)
    boxed, masked = (one.result for one in regnf.register_batch(frames, [box, mask], [path], clouds=False))
    for result in (boxed, masked):
        assert result is not None
        assert result.verdict == "registered"
        assert error_m(result.T_scene_object.matrix(), taken[0].T_world_object) < NEAR_M
    assert masked is not None
    assert masked.camera is not None
    assert masked.camera.frame == "f1"


def test_the_line_of_bop_holds_the_pose_in_millimeters(tmp_path: Path) -> None:
    frame = regnf.Frame(SHOT.depth, K_FILE, mask=SHOT.mask)
    result = regnf.register(frame, write_model(tmp_path), clouds=False)
    scene, image, thing, score, R, t, seconds = result.to_bop_csv(2, 3, 5, 0.25).split(",")
    assert (scene, image, thing, float(seconds)) == ("2", "3", "5", 0.25)
    assert float(score) == pytest.approx(result.probability, abs=1e-6)
    T = np.eye(4)
    T[:3, :3] = np.array(R.split(), float).reshape(3, 3)
    T[:3, 3] = np.array(t.split(), float) / 1000.0
    assert error_m(T, SHOT.T_camera_object, unit=1.0) < 2 * NEAR_M


def test_a_unit_of_another_size_or_none(tmp_path: Path) -> None:
    """Of a model whose size fits no unit the scale is free, and found."""
    mesh = model().copy()
    mesh.apply_scale(3.7)
    frame = regnf.Frame(SHOT.depth, K_FILE, mask=SHOT.mask)
    result = regnf.register(frame, mesh, options={"robust": {"object_unit": "free"}}, clouds=False)
    assert result.camera is not None
    assert result.camera.object_unit is None
    assert result.scale == pytest.approx(3.7, rel=0.05)


@pytest.mark.parametrize(
    ("detection", "said"),
    [(None, "no frame has a mask"), ({"frame": "b", "box_2d": [0, 0, 9, 9]}, "no frame 'b'; it has 0")],
)
def test_a_detection_that_names_nothing_is_refused(detection: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(regnf.RegnfError, match=said):
        regnf.register(regnf.Frame(SHOT.depth, K_FILE), write_model(tmp_path), detection, clouds=False)


def test_an_image_detection_needs_images() -> None:
    with pytest.raises(InvalidDetectionError) as refused:
        regnf.register(model(), model(), {"box_2d": [0, 0, 9, 9]}, clouds=False)
    assert refused.value.reason == "IMAGE_DETECTION_WITHOUT_RECORDING"


def test_the_command_registers_searches_and_does_batches(run: Run, tmp_path: Path) -> None:
    folder, path = write_frame(tmp_path / "frame", SHOT), write_model(tmp_path)
    write_mask(tmp_path / "mask.png", SHOT)
    detection = tmp_path / "detection.json"
    detection.write_text(json.dumps({"mask": "mask.png"}))
    told = run("register", folder, path, "--detection", detection, "--object-unit", "mm", "--output", tmp_path / "out")
    assert told.code == 0, told.stderr
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert error_m(document["camera"]["T_camera_object"]["matrix"], SHOT.T_camera_object) < NEAR_M
    assert document["options"]["robust"]["object_unit"] == "mm"
    assert (tmp_path / "out" / "overlay.png").stat().st_size > 1000
    found = run("search", folder, path, "--detection", detection, "--json")
    assert json.loads(found.stdout)["candidates"][0]["verdict"] == "registered"
    line = {"scene": "frame", "object": "model.stl", "detection": {"mask": "mask.png"}}
    (tmp_path / "pairs.jsonl").write_text(json.dumps(line))
    assert run("batch", tmp_path / "pairs.jsonl", "--processes", "1").code == 0
    (written,) = (tmp_path / "pairs.results.jsonl").read_text().splitlines()
    assert json.loads(written)["verdict"] == "registered"


def test_a_camera_file_of_the_wrong_size_is_refused(run: Run, tmp_path: Path) -> None:
    folder, path = write_frame(tmp_path / "frame", SHOT, width=CAMERA["height"], height=CAMERA["width"]), tmp_path
    (tmp_path / "detection.json").write_text(json.dumps({"box_2d": SHOT.box_2d}))
    told = run("register", folder, write_model(path), "--detection", tmp_path / "detection.json")
    assert told.code == 2
    assert "DATASET_INTRINSICS_INVALID" in told.stderr
