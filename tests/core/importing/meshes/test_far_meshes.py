"""Shapes far from the origin, in files that have the digits: they are what they are at the origin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import regnf
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.families.dense_grid import convert as convert_grid
from regnf_core.importing.mesh_file import load_mesh
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.surface.exporting import write_mesh
from tests.core.importing.archives import saved
from tests.core.importing.in_process import convert
from tests.core.importing.meshes.mesh_files import BALL, converted, field_of, pcd

UTM, ECEF, NEARBY = (500_000.25, 5_000_000.5, 100.0), (4_000_000.3, 3_100_000.1, 2_200_000.7), (60_000.0, 0.0, 0.0)
DOUBLE_PLY = (
    "ply\nformat {} 1.0\nelement vertex {}\n{}element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
PLACES = "".join(f"property double {axis}\n" for axis in "xyz")


def at(shift: tuple[float, float, float]) -> np.ndarray:
    return BALL.vertices + np.array(shift)


def obj(shift: tuple[float, float, float]) -> bytes:
    vertices = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in at(shift).tolist())
    return (vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in (BALL.faces + 1).tolist())).encode()


def ply(shift: tuple[float, float, float], form: str) -> bytes:
    header = DOUBLE_PLY.format(form, len(BALL.vertices), PLACES, len(BALL.faces)).encode()
    if form == "ascii":
        rows = [
            *(" ".join(map(repr, row)) for row in at(shift).tolist()),
            *(f"3 {a} {b} {c}" for a, b, c in BALL.faces),
        ]
        return header + "\n".join(rows).encode()
    faces = np.empty(len(BALL.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, BALL.faces
    return header + at(shift).astype("<f8").tobytes() + faces.tobytes()


def glb(shift: tuple[float, float, float]) -> bytes:
    scene = trimesh.Scene()
    scene.add_geometry(BALL, transform=trimesh.transformations.translation_matrix(shift))
    return bytes(trimesh.exchange.gltf.export_glb(scene))  # type: ignore[no-untyped-call]


def distances(data: bytes, shift: tuple[float, float, float]) -> torch.Tensor:
    """At places round the shape, which is moved by ``shift``."""
    found = converted(data)
    assert [warning for warning in found.warnings if not warning.startswith("SURFACE_RECONSTRUCTED")] == []
    field = field_of(found)
    low, high = field.bounds
    assert (low < torch.tensor(shift)).all()
    assert (high > torch.tensor(shift)).all()
    places = torch.from_numpy(np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3)))
    return field.signed_distance(places + torch.tensor(shift, dtype=torch.float64))


POINTS, POINTS_FACES = trimesh.sample.sample_surface(BALL, 1500, seed=1)


def cloud(shift: tuple[float, float, float]) -> bytes:
    return pcd(POINTS + np.array(shift), BALL.face_normals[POINTS_FACES], "ascii")


@pytest.mark.parametrize(
    ("write", "shift", "tolerance"),
    [
        *((obj, UTM, 1e-6), (glb, ECEF, 1e-6), (lambda s: ply(s, "ascii"), NEARBY, 1e-6)),
        *((lambda s: ply(s, "binary_little_endian"), UTM, 1e-6), (cloud, ECEF, 2e-4)),
    ],
    ids=["obj", "glb", "ply text", "ply", "cloud"],
)
def test_a_shape_keeps_its_digits(write: Any, shift: tuple[float, float, float], tolerance: float) -> None:
    here = distances(write((0.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    torch.testing.assert_close(distances(write(shift), shift), here, rtol=0, atol=tolerance)


def test_a_mesh_goes_through_the_gate_where_it_is(tmp_path: Path) -> None:
    report = convert(saved(tmp_path, glb(ECEF)), tmp_path / "out")
    np.testing.assert_allclose(np.mean(report["bounds"], axis=0), ECEF, rtol=0, atol=0.01)


def test_a_dense_grid_keeps_its_digits(tmp_path: Path) -> None:
    nodes = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 21)] * 3, indexing="ij"), -1)
    values = (np.linalg.norm(nodes, axis=-1) - 0.5).astype(np.float32)
    np.savez(tmp_path / "grid.npz", sdf=values, origin=np.array(UTM) - 1.0, spacing=0.1)
    source = ArraySource(memoryview((tmp_path / "grid.npz").read_bytes()), 1 << 30)
    found = convert_grid(source, UploadDescription.from_dict({"world_scale": 2.0}))
    assert found is not None
    assert np.abs(found.description["origin"]).max() < 4.0
    field = regnf.from_grid(values, np.array(UTM) - 1.0, 0.1)
    node = torch.tensor([UTM], dtype=torch.float64) + torch.tensor([[0.3, 0.0, 0.0]])
    assert field.signed_distance(node).item() == pytest.approx(-0.2, abs=1e-4)


def test_single_precision_far_away_is_said_with_how_much() -> None:
    far = BALL.copy()
    far.apply_translation([50_000.0, 0.0, 0.0])
    (warning,) = converted(far.export(file_type="stl")).warnings
    assert warning.startswith("FAR_FROM_ORIGIN: ")
    assert "single precision has steps of 0.0039" in warning


def test_a_mesh_written_from_afar_is_read_where_it_was(tmp_path: Path) -> None:
    field = regnf.from_mesh(at(UTM), BALL.faces)
    for kind in ("glb", "ply"):
        write_mesh(field, tmp_path / f"far.{kind}", 16)
        low, high = load_mesh(tmp_path / f"far.{kind}").bounds
        torch.testing.assert_close((low + high) / 2, torch.tensor(UTM, dtype=torch.float64), rtol=0, atol=1e-3)


def test_a_pose_far_away_is_that_at_the_origin(tmp_path: Path) -> None:
    thing = trimesh.util.concatenate(
        [trimesh.creation.box((0.5, 0.4, 0.1)), trimesh.creation.box((0.1, 0.4, 0.5), _moved(0.2, 0.0, 0.3))]
    )
    thing = trimesh.util.concatenate([thing, trimesh.creation.box((0.1, 0.1, 0.3), _moved(-0.2, 0.1, 0.2))])
    T = trimesh.transformations.rotation_matrix(0.6, (0, 0, 1))
    T[:3, 3] = (0.3, 0.2, 0.05)
    placed = thing.copy().apply_transform(T)
    room = trimesh.util.concatenate([placed, trimesh.creation.box((3.0, 3.0, 0.1), _moved(0.0, 0.0, -0.06))])
    low, high = placed.bounds[0] - 0.05, placed.bounds[1] + 0.05
    fields = [regnf.from_mesh(one.vertices + by, one.faces) for one, by in ((room, UTM), (thing, ECEF))]
    found = regnf.register(*fields, {"min": low + np.array(UTM), "max": high + np.array(UTM)})
    assert found.verdict == "registered"
    pose = _moved(*(-np.array(ECEF))) @ found.T_object_scene.matrix().numpy() @ _moved(*UTM)
    assert np.abs(found.scene_samples.points.numpy() - np.array(UTM)).max() < 3.0
    np.testing.assert_allclose(np.linalg.inv(pose), T, rtol=0, atol=5e-6)
    found.save(tmp_path / "out")
    header, _, body = (tmp_path / "out" / "scene_points.ply").read_bytes().partition(b"end_header\n")
    assert b"property double x" in header
    assert np.abs(np.frombuffer(body, "<f8", 3) - np.array(UTM)).max() < 3.0


def _moved(*shift: float) -> np.ndarray:
    matrix: np.ndarray = trimesh.transformations.translation_matrix(shift)
    return matrix


def test_the_report_s_surface_lies_where_the_file_has_it(tmp_path: Path) -> None:
    """A box is written by these numbers."""
    report = convert(saved(tmp_path, ply(UTM, "binary_little_endian")), tmp_path / "out", None)
    low, high = np.array(report["surface_bounds"])
    np.testing.assert_allclose(low, at(UTM).min(axis=0), rtol=0, atol=0.1)
    np.testing.assert_allclose(high, at(UTM).max(axis=0), rtol=0, atol=0.1)
