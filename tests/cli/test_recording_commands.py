"""Recordings at the command line: what is said of them, ``regnf inspect`` and ``regnf fuse``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import regnf
from regnf_cli.options import given_of
from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_core.schema.safe_format import read_description
from regnf_data.recordings.images import images_of
from regnf_data.recordings.opening import open_recording
from tests.cli.conftest import Run
from tests.data.recordings import writers
from tests.data.recordings.truth import K, walk


@pytest.mark.parametrize(
    ("said", "step"), [("mm", 0.001), ("m", 1.0), ("0.0002", 0.0002), ("5000", 0.0002), ("1", 0.001), ("0.1", 0.0001)]
)
def test_units_of_depth(said: str, step: float) -> None:
    assert given_of(depth_unit=said).depth_unit == pytest.approx(step)


@pytest.mark.parametrize("said", ["feet", "nan", "0", "-1", "inf", ""])
def test_what_is_no_unit_is_refused(said: str) -> None:
    with pytest.raises(InvalidOptionsError, match="--depth-unit"):
        given_of(depth_unit=said)


def test_intrinsics_are_a_file_or_numbers(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    np.savetxt(path, K)
    written = given_of(intrinsics=str(path)).camera
    typed = given_of(intrinsics=f"{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]},80,60").camera
    assert written is not None
    assert typed is not None
    assert np.allclose(written.K, typed.K)
    assert typed.size == (60, 80)


@pytest.mark.parametrize("said", ["nothing.json", "1,2,3", "500,500,nan,240", "0,500,320,240"])
def test_what_are_no_intrinsics_is_refused(said: str) -> None:
    with pytest.raises((InvalidOptionsError, DatasetError), match="--intrinsics"):
        given_of(intrinsics=said)


@pytest.mark.parametrize("axes", ["opencv", "opengl", None])
def test_cameras_look_where_it_is_said(axes: str | None, tmp_path: Path) -> None:
    truth = walk(2)
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    for writer, own in ((writers.redwood, "opencv"), (writers.nerfstudio, "opengl")):
        folder = writer(tmp_path / f"{own}", truth)
        found = open_recording(folder, given_of(axes=axes)).frames[0].T_world_camera  # type: ignore[arg-type]
        assert np.allclose(found, truth.poses[0] @ (np.eye(4) if axes in (None, own) else opengl), atol=1e-5)


def report(run: Run, *command: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run("inspect", *command, "--json", code=0).stdout)
    return found


@pytest.mark.parametrize("name", ["scannet", "tum", "nerfstudio", "replica"])
def test_inspect_says_what_a_recording_is(name: str, run: Run, tmp_path: Path) -> None:
    writer, step = writers.FOLDERS[name]
    folder = writer(tmp_path / "recording", walk())
    found = report(run, folder, "--picture", tmp_path / "it.png")
    assert (found["kind"], found["frames"], found["depth_images"]) == ("recording", 6, "80 x 60")
    assert found["color_images"] == ("160 x 120" if name == "scannet" else "80 x 60")
    assert found["depth_step"] == pytest.approx(1 / 6553.5 if name == "replica" else step, rel=0.01)
    assert found["camera"]["focal_px"] == [70.0, 72.0]
    assert np.allclose(np.array(found["bounds"])[:, 2], (-0.2, 1.95), atol=0.1)
    assert "agree" in found["agreement"]
    assert found["unit"] == "meters"
    assert len(found["notes"]) == (name == "scannet")
    with Image.open(tmp_path / "it.png") as picture:
        assert picture.size == (1320, 360)
    printed = run("inspect", folder, code=0).stdout
    assert f"regnf fuse {folder} map.safetensors" in printed.replace("\n", " ")


def test_inspect_tells_a_wrong_unit_and_a_frame_alone(run: Run, tmp_path: Path) -> None:
    folder = writers.tum(tmp_path / "recording", walk())
    found = report(run, folder, "--depth-unit", "mm")
    assert found["depth_step_from"] == "as given"
    assert "DATASET_FRAMES_DISAGREE" in found["agreement"]
    writers.depth_png(tmp_path / "depth.png", walk(1).depths[0], 1000.0)
    found = report(run, tmp_path / "depth.png", "--intrinsics", "70,72,39,31", "--picture", tmp_path / "it.png")
    assert (found["frames"], found["depth_step_from"], found["color_images"]) == (1, "a guess", None)
    assert run("inspect", tmp_path / "depth.png", code=2).stderr.count("--intrinsics")


def test_inspect_of_a_folder_names_the_recordings_in_it(run: Run, tmp_path: Path) -> None:
    writers.redwood(tmp_path / "kitchen", walk(2))
    assert "kitchen" in run("inspect", tmp_path, code=2).stderr


def test_fuse_takes_any_layout_and_refuses_what_disagrees(run: Run, tmp_path: Path) -> None:
    folder = writers.tum(tmp_path / "recording", walk())
    output = tmp_path / "map.safetensors"
    refused = run("fuse", folder, output, "--depth-unit", "mm", code=2).stderr
    assert "DATASET_FRAMES_DISAGREE" in refused
    assert not output.exists()
    outcome = run("fuse", folder, output, "--voxel", 0.05, code=0)
    assert "bounds around the measured depths" in outcome.stderr
    assert read_description(output)["kind"] == "voxel_blocks"
    for bounds in ("1,2,3", "one,2,3,4,5,6"):
        assert "--bounds" in run("fuse", folder, output, "--bounds", bounds, code=2).stderr


def test_fuse_in_python_within_bounds(tmp_path: Path) -> None:
    folder = writers.bop(tmp_path / "recording", walk(4))
    made = regnf.fuse(folder, tmp_path / "map.safetensors", {"voxel": 0.05}, [[-1, 0, -0.5], [1, 3, 1]])
    assert made.images == 4
    assert regnf.open_field(tmp_path / "map.safetensors").bounds.amin(0)[0] > -1.5


def test_images_of_sdfstudio_without_bounds_are_taken_whole(tmp_path: Path) -> None:
    taken = images_of(writers.sdfstudio(tmp_path / "recording", walk(3)))
    assert len(taken.images) == 3
    assert taken.images.bounds[1, 1] > 2.0  # beyond the usual cube
    assert len(taken.notes) == 1


def test_frames_that_add_most_are_taken(tmp_path: Path) -> None:
    folder = writers.redwood(tmp_path / "recording", walk(12))
    taken = images_of(folder, most=3)
    assert len(taken.images) == 3
    assert "3 of 12 frames" in taken.notes[0]
