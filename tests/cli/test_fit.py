"""``regnf fit`` and ``regnf fuse`` of a folder of images, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from regnf_core.schema.safe_format import read_description
from regnf_data.sdfstudio import write_dataset
from tests.cli.conftest import Run
from tests.fit.images import scenes
from tests.fit.images.test_agreement import OPENGL, recording

SMALL = ("--iterations", 20, "--table-log2", 10, "--hidden-width", 16, "--device", "cpu")


def test_a_dataset_becomes_a_field_with_snapshots_and_a_checkpoint(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=3), tmp_path / "images")
    output, exported = tmp_path / "two.safetensors", tmp_path / "two.ckpt"
    more = ("--snapshots", "10,50", "--sdfstudio", exported, "--start", "object", "--label", "two")
    outcome = run("fit", tmp_path / "images", output, *SMALL, *more)
    assert outcome.code == 0, outcome.stderr
    assert "eikonal_error" in outcome.stdout
    assert read_description(output)["label"] == "two"
    names = {"images", "two.safetensors", "two.ckpt", "config.yml", "two-after-10-percent.safetensors"}
    assert {path.name for path in tmp_path.iterdir()} == names | {"two-after-50-percent.safetensors"}


@pytest.mark.parametrize("more", [["--snapshots", "1"], ["--pictures"], ["--start", "room"], ["--device", "cpu"]])
def test_options_for_images_are_refused_for_meshes(more: list[str], run: Run, tmp_path: Path) -> None:
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    outcome = run("fit", tmp_path / "mesh.obj", tmp_path / "field.safetensors", *more)
    assert outcome.code == 2
    assert "INVALID_OPTIONS " in outcome.stderr


def test_a_dataset_becomes_a_map(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=3), tmp_path / "images")
    outcome = run("fuse", tmp_path / "images", tmp_path / "map.safetensors", "--voxel", "0.02", "--label", "two")
    assert outcome.code == 0, outcome.stderr
    assert "depth_error_median" in outcome.stdout
    description = read_description(tmp_path / "map.safetensors")
    assert (description["label"], description["kind"]) == ("two", "voxel_blocks")
    assert {path.name for path in tmp_path.iterdir()} == {"images", "map.safetensors"}


@pytest.mark.parametrize(
    ("command", "output", "more"),
    [("fuse", "map.ply", []), ("fuse", "absent/map.safetensors", []), ("fuse", "a.safetensors", ["--voxel", "0"]),
     ("fuse", "a.safetensors", ["--voxel", "nan"]), ("fuse", "a.safetensors", ["--voxel", "1e308"]),
     ("fuse", "a.safetensors", ["--label", 201 * "x"]), ("fit", "a.safetensors", ["--snapshots", "0"]),
     ("fit", "a.safetensors", ["--snapshots", "100"]), ("fit", "a.safetensors", ["--snapshots", "one"]),
     ("fit", "a.safetensors", ["--extent", "1"])],
)  # fmt: skip
def test_options_that_cannot_be_meant_are_refused(
    command: str, output: str, more: list[str], run: Run, tmp_path: Path
) -> None:
    write_dataset(scenes.images(count=2), tmp_path / "images")
    outcome = run(command, tmp_path / "images", tmp_path / output, *more)
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
