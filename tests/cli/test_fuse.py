"""``regnf fuse``: a map of a folder of images, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from regnf_core.schema.safe_format import read_description
from regnf_data.sdfstudio import write_dataset
from tests.cli.conftest import Run
from tests.fit.images import scenes
from tests.fit.images.test_agreement import OPENGL, recording


def test_a_dataset_becomes_a_map(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=3), tmp_path / "images")
    outcome = run("fuse", tmp_path / "images", tmp_path / "map.safetensors", "--voxel", "0.02", "--label", "two")
    assert outcome.code == 0, outcome.stderr
    assert "depth_error_median" in outcome.stdout
    description = read_description(tmp_path / "map.safetensors")
    assert (description["label"], description["kind"]) == ("two", "voxel_blocks")
    assert {path.name for path in tmp_path.iterdir()} == {"images", "map.safetensors"}


@pytest.mark.parametrize(
    ("output", "more"),
    [("map.ply", []), ("absent/map.safetensors", []), ("map.safetensors", ["--voxel", "0"]),
     ("map.safetensors", ["--voxel", "nan"]), ("map.safetensors", ["--voxel", "1e308"]),
     ("map.safetensors", ["--label", 201 * "x"])],
)  # fmt: skip
def test_options_that_cannot_be_meant_are_refused(output: str, more: list[str], run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=2), tmp_path / "images")
    outcome = run("fuse", tmp_path / "images", tmp_path / output, *more)
    assert outcome.code == 2
    assert "INVALID_OPTIONS " in outcome.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_cameras_of_opengl_are_refused_and_the_option_takes_them(run: Run, tmp_path: Path) -> None:
    images = recording(8)
    write_dataset(replace(images, T_world_camera=images.T_world_camera @ OPENGL), tmp_path / "images")
    command = "fuse", tmp_path / "images", tmp_path / "map.safetensors", "--voxel", "0.06"
    refused = run(*command)
    assert refused.code == 2
    assert "DATASET_FRAMES_DISAGREE" in refused.stderr
    assert "--camera-axes opengl" in " ".join(refused.stderr.split())
    outcome = run(*command, "--camera-axes", "opengl")
    assert outcome.code == 0, outcome.stderr
    assert "warning" not in outcome.stdout + outcome.stderr
