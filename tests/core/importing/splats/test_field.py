"""Gaussian splats on known surfaces as fields: distances, what was observed, and the ways to give cameras."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import ObservedField, SdfField
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.splats.gaussians import Doubles, Splats, write_ply

VOXEL = 2.12 / 256
"""Of a sphere of radius 1: its box has a margin of 3 % of its diagonal."""


def surfels(points: Doubles, normals: Doubles, wide: float, seed: int = 0) -> Splats:
    """Thin splats with their short axes along the normals."""
    turns = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1)
    turns[np.linalg.norm(turns, axis=1) < 1e-6] = [0, 1, 0, 0]
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    random, count = np.random.default_rng(seed), len(points)
    scales = np.log(np.column_stack([wide * random.uniform(0.7, 1.3, (count, 2)), np.full(count, wide / 20)]))
    colors = np.tile([1.0, 0.0, -1.0], (count, 1, 1)).astype(np.float32)
    opacities = random.uniform(0.6, 1.0, count).astype(np.float32)
    return Splats(points, scales.astype(np.float32), turns.astype(np.float32), opacities, colors)


def ball(count: int = 12_000, noise: float = 0.0, center: Doubles | None = None) -> Splats:
    random = np.random.default_rng(1)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * (1.0 + noise * random.normal(size=(count, 1)))
    return surfels(points + (0.0 if center is None else center), normals, 1.5 * np.sqrt(4 * np.pi / count))


def floaters(count: int, reach: float) -> Splats:
    random = np.random.default_rng(2)
    return surfels(random.uniform(-reach, reach, (count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1)), 0.02)


def room(count: int = 40_000) -> Splats:
    """The walls of a box of 4 x 3 x 2.5 from within, and a ball of radius 0.4 on its floor."""
    random, size = np.random.default_rng(3), np.array([4.0, 3.0, 2.5])
    points, normals = random.uniform(0, 1, (count, 3)) * size, np.zeros((count, 3))
    axis, side = random.integers(3, size=count), random.integers(2, size=count)
    points[np.arange(count), axis] = side * size[axis]
    normals[np.arange(count), axis] = 1 - 2 * side
    thing = random.normal(size=(count // 8, 3))
    thing /= np.linalg.norm(thing, axis=1, keepdims=True)
    own = surfels(points, normals, 0.06)
    return Splats.together([own, surfels([2.0, 1.5, 0.4] + 0.4 * thing, thing, 0.04)])


def field_of(splats: Splats, folder: Path, said: dict[str, Any] | None = None, cameras: Path | None = None) -> SdfField:
    """As imported in this process."""
    folder.mkdir(exist_ok=True)
    (folder / "upload").write_bytes(write_ply(splats))
    beside = Companions(cameras=None if cameras is None else (cameras.name, cameras))
    convert_file(folder / "upload", folder, said, ImportLimits(), beside=beside)
    return open_field(folder / FIELD_NAME)


def off_the_surface(field: SdfField, radius: float, center: Doubles | None = None) -> Doubles:
    """Values in 2,000 places on a sphere, where the distance is zero."""
    directions = np.random.default_rng(4).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = radius * directions + (0.0 if center is None else center)
    return field.signed_distance(torch.from_numpy(points).float()).numpy()


def test_a_ball_among_floaters_is_a_ball(tmp_path: Path) -> None:
    """Noise of half a percent in many sheets moves the surface by a fraction of a voxel; floaters are gone."""
    field = field_of(Splats.together([ball(noise=0.005), floaters(300, 1.3)]), tmp_path)
    off = off_the_surface(field, 1.0)
    assert abs(np.median(off)) < 0.7 * VOXEL
    assert np.quantile(np.abs(off), 0.95) < 2.0 * VOXEL
    inside, outside = off_the_surface(field, 0.97), off_the_surface(field, 1.03)
    assert (inside < 0).mean() > 0.99
    assert (outside > 0).mean() > 0.99
    assert (off_the_surface(field, 1.2) > 0).mean() > 0.99
    for radius in (0.9, 0.6, 0.3, 0.05):  # no view looks there: matter
        assert (off_the_surface(field, radius) < 0).all()


def test_a_room_is_free_within_and_observed_there(tmp_path: Path) -> None:
    field = field_of(room(), tmp_path, {"as": "scene"})
    assert isinstance(field, ObservedField)
    free = torch.tensor([[1.0, 1.0, 1.0], [3.0, 2.5, 2.0], [2.0, 1.5, 1.5], [0.3, 0.3, 0.3]])
    assert (field.signed_distance(free) > 0).all()
    assert field.observation.at(free).tolist() == [1, 1, 1, 1]
    within_the_ball = torch.tensor([[2.0, 1.5, 0.4]])
    assert field.observation.at(within_the_ball).tolist() == [0]
    wall = torch.tensor([[0.04, 1.5, 1.2], [-0.03, 1.5, 1.2], [2.0, 1.5, 0.83], [2.0, 1.5, 0.75]])
    near, behind, above, below = field.signed_distance(wall).tolist()
    assert near == pytest.approx(0.04, abs=0.02)
    assert behind < 0 < above
    assert below < 0


def test_far_from_the_origin_nothing_is_lost(tmp_path: Path) -> None:
    center = np.array([450_000.0, 5_400_000.0, 300.0])
    far = ball(center=center)
    (tmp_path / "upload").write_bytes(_double_ply(far))
    convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    field = open_field(tmp_path / FIELD_NAME)
    directions = np.random.default_rng(4).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    off = field.signed_distance(torch.from_numpy(center + directions)).numpy()
    assert np.quantile(np.abs(off), 0.95) < 2.0 * VOXEL


def _double_ply(splats: Splats) -> bytes:
    """With places in double precision, which the trainers' files do not have."""
    single = write_ply(splats)
    start = single.index(b"end_header\n") + len(b"end_header\n")
    names = [line.split()[-1].decode() for line in single[:start].splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(single[start:], [(name, "<f4") for name in names])
    wide = np.empty(len(rows), [(name, "<f8" if name in "xyz" else "<f4") for name in names])
    for name in names:
        wide[name] = splats.means[:, "xyz".index(name)] if name in "xyz" else rows[name]
    header = single[:start]
    for axis in (b"x", b"y", b"z"):
        header = header.replace(b"property float " + axis + b"\n", b"property double " + axis + b"\n")
    return header + wide.tobytes()


def test_faint_splats_have_no_surface(tmp_path: Path) -> None:
    faint = ball()
    faint.opacities[:] = 0.02
    with pytest.raises(FieldFormatError) as caught:
        field_of(faint, tmp_path)
    assert caught.value.reason == "NO_ZERO_LEVEL"


def training_cameras(count: int) -> list[dict[str, Any]]:
    """In the list that the trainer of 3DGS writes, on a ring around the ball, of its upper half alone."""
    found = []
    for number in range(count):
        turn = 2 * np.pi * number / count
        place = 3.0 * np.array([np.cos(turn) * 0.8, np.sin(turn) * 0.8, 0.6])
        ahead = -place / np.linalg.norm(place)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        size = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0}
        found.append({"id": number, "position": place.tolist(), "rotation": axes.tolist(), **size})
    return found


def test_a_training_run_of_3dgs_is_seen_by_its_own_cameras(tmp_path: Path) -> None:
    """The newest step of several is taken, and what the cameras never saw is unobserved."""
    with zipfile.ZipFile(tmp_path / "run.zip", "w") as archive:
        archive.writestr("out/cameras.json", json.dumps(training_cameras(24)))
        archive.writestr("out/input.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
        archive.writestr("out/point_cloud/iteration_7000/point_cloud.ply", write_ply(ball(2000)))
        archive.writestr("out/point_cloud/iteration_30000/point_cloud.ply", write_ply(ball()))
    report = convert_file(tmp_path / "run.zip", tmp_path, None, ImportLimits())
    assert "iteration_30000" in report["why"][0]
    assert "24 of the 24 cameras" in report["why"][1]
    field = open_field(tmp_path / FIELD_NAME)
    assert isinstance(field, ObservedField)
    below, above = torch.tensor([[0.0, 0.0, -1.005]]), torch.tensor([[0.0, 0.0, 1.005]])
    assert field.observation.at(above).tolist() == [2]
    assert field.observation.at(below).tolist() == [0]


def test_given_cameras_are_used(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(json.dumps(training_cameras(16)))
    field = field_of(ball(), tmp_path / "given", cameras=tmp_path / "cameras.json")
    points = np.random.default_rng(5).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    seen = points[points[:, 2] > 0.3]
    assert np.quantile(np.abs(field.signed_distance(torch.from_numpy(seen).float()).numpy()), 0.9) < 2 * VOXEL


def test_splatfacto_has_the_field_of_its_splats(tmp_path: Path) -> None:
    splats = ball()
    logits = np.log(splats.opacities / (1.0001 - splats.opacities))[:, None]
    state = {"means": splats.means, "scales": splats.scales, "quats": splats.rotations, "opacities": logits}
    state |= {"features_dc": splats.harmonics[:, 0], "features_rest": np.zeros((len(splats), 15, 3))}
    tensors = {f"_model.gauss_params.{name}": torch.from_numpy(value).float() for name, value in state.items()}
    torch.save({"step": 1, "pipeline": tensors}, tmp_path / "upload")
    report = convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    assert report["family"] == "gaussian_splats"
    assert "16 coefficients" in report["why"][0]
    assert np.quantile(np.abs(off_the_surface(open_field(tmp_path / FIELD_NAME), 1.0)), 0.95) < 2.0 * VOXEL


def test_the_confined_process_can_do_it(tmp_path: Path) -> None:
    (tmp_path / "upload").write_bytes(write_ply(ball()))
    (tmp_path / "out").mkdir()
    report = import_field(tmp_path / "upload", tmp_path / "out", {"as": "object"})
    assert report.family == "gaussian_splats"
    assert any(warning.startswith("SURFACE_RECONSTRUCTED") for warning in report.warnings)


def test_options_that_mean_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FieldFormatError) as caught:
        field_of(ball(), tmp_path, {"truncation": 0.1})
    assert caught.value.reason == "INVALID_DESCRIPTION"
