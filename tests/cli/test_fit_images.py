"""``regnf fit`` of a folder of images: what it writes, and what it refuses before the work."""

from __future__ import annotations

from pathlib import Path

import pytest

from regnf_core.schema.safe_format import read_description
from regnf_data.sdfstudio import write_dataset
from tests.cli.conftest import Run
from tests.fit.images import scenes

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


@pytest.mark.parametrize(
    "more", [["--snapshots", "0"], ["--snapshots", "100"], ["--snapshots", "one"], ["--extent", "1"]]
)
def test_options_that_cannot_be_meant_are_refused(more: list[str], run: Run, tmp_path: Path) -> None:
    write_dataset(scenes.images(count=2), tmp_path / "images")
    outcome = run("fit", tmp_path / "images", tmp_path / "field.safetensors", *more)
    assert outcome.code == 2
    assert "INVALID_OPTIONS " in outcome.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


@pytest.mark.parametrize("more", [["--snapshots", "1"], ["--pictures"], ["--start", "room"], ["--device", "cpu"]])
def test_options_for_images_are_refused_for_meshes(more: list[str], run: Run, tmp_path: Path) -> None:
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    outcome = run("fit", tmp_path / "mesh.obj", tmp_path / "field.safetensors", *more)
    assert outcome.code == 2
    assert "INVALID_OPTIONS " in outcome.stderr
