"""``regnf convert``: what it writes, and what it refuses before the work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.worlds.dataset_writer import write_dataset
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import observation_of
from regnf_core.schema.safe_format import read_description
from regnf_fit.images.observing import observe
from tests.cli.conftest import DATA, Run
from tests.fit.images.scenes import BALL_CENTER, BALL_RADIUS, BOX_CENTER, BOX_HALF, images


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.usefixtures("cache")
def test_a_mesh_becomes_a_safe_field_and_a_grid(run: Run, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.5).export(tmp_path / "ball.glb")
    (tmp_path / "said.json").write_text('{"label": "ball"}')
    safe, grid = tmp_path / "ball.safetensors", tmp_path / "ball.npz"
    outcome = run("convert", tmp_path / "ball.glb", safe, "--description", tmp_path / "said.json", code=0)
    assert outcome.stdout.startswith(f"{safe}: mesh, ")
    assert (read_description(safe)["kind"], read_description(safe)["label"]) == ("mesh", "ball")
    assert open_field(safe).signed_distance(torch.zeros(1, 3)).item() == pytest.approx(-0.5, abs=0.01)
    assert run("convert", safe, grid, "--resolution", 8).code == 0
    assert np.load(grid)["sdf"].shape == (9, 9, 9)
    assert {path.name for path in tmp_path.glob("ball*")} == {"ball.glb", safe.name, grid.name}


@pytest.mark.usefixtures("cache")
def test_a_node_of_a_scene_is_chosen(run: Run, tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for name, radius in (("small", 0.5), ("large", 2.0)):
        scene.add_geometry(trimesh.creation.icosphere(subdivisions=2, radius=radius), node_name=name)
    scene.export(tmp_path / "balls.glb")
    run("convert", tmp_path / "balls.glb", tmp_path / "ball.safetensors", "--node", "small", code=0)
    found = open_field(tmp_path / "ball.safetensors").signed_distance(torch.zeros(1, 3))
    assert found.item() == pytest.approx(-0.5, abs=0.02)
    refused = run("inspect", tmp_path / "balls.glb", "--node", "medium", code=2)
    assert "no node with a shape is named 'medium'; the file has large, small" in refused.stderr


def test_a_field_becomes_a_mesh(run: Run, tmp_path: Path) -> None:
    outcome = run("convert", DATA / "armchair.safetensors", tmp_path / "chair.ply", "--resolution", 24, code=0)
    assert "triangles" in outcome.stdout
    assert trimesh.load_mesh(tmp_path / "chair.ply").is_watertight


@pytest.mark.usefixtures("cache")
def test_what_is_read_is_not_overwritten(run: Run, tmp_path: Path) -> None:
    mesh, link = tmp_path / "chair.ply", tmp_path / "link.ply"
    trimesh.creation.box().export(mesh)
    link.symlink_to(mesh)
    before = mesh.read_bytes()
    for given, output in ((mesh, mesh), (mesh, link), (link, mesh)):
        outcome = run("convert", given, output, code=2)
        assert outcome.stderr.startswith(
            f"INVALID_OPTIONS {output}: this is an input file, and it would be overwritten"
        )
    assert mesh.read_bytes() == before


@pytest.mark.usefixtures("cache")
def test_what_images_have_seen_is_kept_with_the_field(run: Run, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=BALL_RADIUS).apply_translation(BALL_CENTER)
    box = trimesh.creation.box(extents=2.0 * BOX_HALF).apply_translation(BOX_CENTER)
    trimesh.util.concatenate([ball, box]).export(tmp_path / "scene.glb")
    seen = images(count=4)
    write_dataset(seen, tmp_path / "images")
    safe = tmp_path / "scene.safetensors"
    run("convert", tmp_path / "scene.glb", safe, "--images", tmp_path / "images", code=0)
    kept, made = observation_of(open_field(safe)), observe(seen, 160)
    assert kept is not None
    assert made is not None
    assert (kept.states == made.states).float().mean() > 0.999  # depths are stored in steps
    other = DATA / "armchair.safetensors"
    refused = run("convert", other, tmp_path / "other.safetensors", "--images", tmp_path / "images")
    assert (refused.code, "DATASET_OF_ANOTHER_FRAME" in refused.stderr) == (2, True)
    unsafe = run("convert", tmp_path / "scene.glb", tmp_path / "scene.ply", "--images", tmp_path / "images")
    assert (unsafe.code, "INVALID_OPTIONS" in unsafe.stderr) == (2, True)
    assert {path.name for path in tmp_path.iterdir()} <= {"scene.glb", "images", safe.name, "cache"}


@pytest.mark.usefixtures("cache")
def test_a_mesh_is_observed_from_where_its_cameras_stood(run: Run, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=1, radius=0.5).export(tmp_path / "ball.glb")
    # Half a turn about x: a camera at (0, 0, 1.5) that looks down on the ball.
    poses = [f"{index} {0.1 * index} 0 1.5 1 0 0 0" for index in range(3)]
    (tmp_path / "poses.txt").write_text("\n".join(poses))
    said = ("--intrinsics", "25,25,16,12,32,24")
    safe = tmp_path / "ball.safetensors"
    run("convert", tmp_path / "ball.glb", safe, "--cameras", tmp_path / "poses.txt", *said, code=0)
    assert "it has an observation" in run("inspect", safe).stdout
    observation = observation_of(open_field(safe))
    assert observation is not None
    assert observation.at(torch.tensor([[0.0, 0.0, 0.49], [0.0, 0.0, -0.49], [0.0, 0.0, 0.0]])).tolist() == [2, 0, 0]
    options = ("--cameras", tmp_path / "poses.txt", *said, "--camera-axes", "opengl")
    refused = run("convert", tmp_path / "ball.glb", safe, *options, code=2).stderr
    assert "CAMERAS_OF_ANOTHER_FRAME" in refused
    assert "give --camera-axes opencv" in " ".join(refused.split())
    assert "INVALID_OPTIONS" in run("convert", tmp_path / "ball.glb", safe, *said, code=2).stderr
