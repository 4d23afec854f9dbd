"""``regnf fit`` and ``regnf fuse`` of a folder of images, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.worlds.dataset_writer import write_dataset
from regnf_core.schema.safe_format import read_description
from tests.cli.conftest import Run
from tests.fit.images import scenes
from tests.fit.images.test_agreement import OPENGL, recording

SMALL = ("--iterations", 20, "--table-log2", 10, "--hidden-width", 16, "--device", "cpu")


def test_a_dataset_becomes_a_field_with_snapshots_and_a_checkpoint(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=3), tmp_path / "images")
    output, exported = tmp_path / "two.safetensors", tmp_path / "two.ckpt"
    more = ("--snapshots", "10,50", "--sdfstudio", exported, "--start", "object", "--label", "two")
    outcome = run("fit", tmp_path / "images", output, *SMALL, *more, code=0)
    assert "eikonal_error" in outcome.stdout
    assert read_description(output)["label"] == "two"
    names = {"images", "two.safetensors", "two.ckpt", "config.yml", "two-after-10-percent.safetensors"}
    assert {path.name for path in tmp_path.iterdir()} == names | {"two-after-50-percent.safetensors"}


def test_a_dataset_becomes_a_map(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=3), tmp_path / "images")
    outcome = run(
        "fuse", tmp_path / "images", tmp_path / "map.safetensors", "--voxel", "0.02", "--label", "two", code=0
    )
    assert "depth_error_median" in outcome.stdout
    description = read_description(tmp_path / "map.safetensors")
    assert (description["label"], description["kind"]) == ("two", "voxel_blocks")
    assert {path.name for path in tmp_path.iterdir()} == {"images", "map.safetensors"}


MESHES = {
    "triangle.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "point.obj": "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
    "nothing.obj": "f 1 2 3\n",
}
REFUSED: list[tuple[str, str, str, list[str]]] = [
    *[("fit", "triangle.obj", "a.safetensors", more) for more in (
        ["--snapshots", "1"], ["--pictures"], ["--start", "room"], ["--device", "cpu"], ["--extent", "0"],
        ["--extent", "-1"], ["--extent", "nan"], ["--label", 201 * "x"])],
    ("fit", "triangle.obj", "field.txt", []), ("fit", "triangle.obj", "absent/a.safetensors", []),
    *[("fit", "images", "a.safetensors", more) for more in (
        ["--snapshots", "0"], ["--snapshots", "100"], ["--snapshots", "one"], ["--extent", "1"])],
    *[("fuse", "images", "a.safetensors", more) for more in (
        ["--voxel", "0"], ["--voxel", "nan"], ["--voxel", "1e308"], ["--label", 201 * "x"])],
    ("fuse", "images", "map.ply", []), ("fuse", "images", "absent/map.safetensors", []),
    ("fit", "nothing.obj", "a.safetensors", []), ("fit", "point.obj", "a.safetensors", []),
    ("fit", "point.obj", "a.safetensors", ["--extent", "1"]),
]  # fmt: skip


def test_what_cannot_be_meant_is_refused(run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=2), tmp_path / "images")
    for name, text in MESHES.items():
        (tmp_path / name).write_text(text)
    before = sorted(tmp_path.iterdir())
    for command, source, output, more in REFUSED:
        outcome = run(command, tmp_path / source, tmp_path / output, *more)
        reason = "MESH_INVALID" if source in ("nothing.obj", "point.obj") else "INVALID_OPTIONS"
        assert (outcome.code, f"{reason} " in outcome.stderr) == (2, True), (command, source, output, more)
        assert sorted(tmp_path.iterdir()) == before


def test_cameras_of_opengl_are_refused_and_the_option_takes_them(run: Run, tmp_path: Path) -> None:
    images = recording(8)
    write_dataset(replace(images, T_world_camera=images.T_world_camera @ OPENGL), tmp_path / "images")
    command = "fuse", tmp_path / "images", tmp_path / "map.safetensors", "--voxel", "0.06"
    refused = run(*command, code=2)
    assert "DATASET_FRAMES_DISAGREE" in refused.stderr
    assert "--camera-axes opengl" in " ".join(refused.stderr.split())
    outcome = run(*command, "--camera-axes", "opengl", code=0)
    assert "warning" not in outcome.stdout + outcome.stderr
