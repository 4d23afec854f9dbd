"""Fields of what lies in memory, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import torch
import trimesh
from torch import Tensor

import regnf
from regnf_core import loading

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
V, F = np.asarray(BALL.vertices), np.asarray(BALL.faces)
NAMES = "from_mesh, from_points, from_grid or from_function"
CUBE = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
BOX = {"min": CUBE[0], "max": CUBE[1]}
POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-0.7, 0.7, (200, 3))).float()
GRID = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 17)] * 3, indexing="ij"), -1), axis=-1) - 0.5


def legacy() -> Any:
    return open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(V), open3d.utility.Vector3iVector(F))


@pytest.fixture(scope="module")
def from_file(tmp_path_factory: pytest.TempPathFactory) -> regnf.SdfField:
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    BALL.export(path)
    return regnf.open_field(path)


@pytest.mark.parametrize(
    "make",
    [
        lambda: regnf.from_mesh(V, F),
        lambda: regnf.from_mesh(V.astype("f4"), F.astype("u2")),
        lambda: regnf.from_mesh(V.tolist(), F.tolist()),
        lambda: regnf.from_mesh(torch.tensor(V, requires_grad=True), torch.tensor(F)),
        lambda: regnf.from_mesh(V[::-1], len(V) - 1 - F),
        lambda: regnf.from_mesh(np.asfortranarray(V), np.asfortranarray(F)),
        lambda: regnf.from_mesh(np.vstack([V, [[np.nan] * 3]]), F),
        lambda: regnf.open_field(BALL),
        lambda: regnf.open_field(trimesh.Scene(BALL)),
        lambda: regnf.open_field(legacy()),
        lambda: regnf.open_field(open3d.t.geometry.TriangleMesh.from_legacy(legacy())),
    ],
)
def test_a_mesh_in_memory_is_that_of_its_file(make: Callable[[], regnf.SdfField], from_file: regnf.SdfField) -> None:
    for mine, expected in zip(
        make().signed_distance_and_gradient(POINTS), from_file.signed_distance_and_gradient(POINTS), strict=True
    ):
        assert torch.equal(mine, expected)


def test_polygons_are_cut_into_triangles() -> None:
    corners = trimesh.creation.box((1.0, 1.0, 1.0)).vertices
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    mixed = [*quads[1:], [0, 1, 3], [0, 3, 2]]
    for faces in (quads, mixed):
        field = regnf.from_mesh(corners, faces)
        assert field.signed_distance(torch.zeros(1, 3)).item() == pytest.approx(-0.5)


@pytest.mark.parametrize("tensor", [False, True])
def test_a_cloud_of_open3d_is_taken(tensor: bool) -> None:
    cloud: Any = legacy().sample_points_uniformly(1200, use_triangle_normal=True)
    with pytest.warns(regnf.FieldWarning, match="SURFACE_RECONSTRUCTED"):
        field = regnf.open_field(open3d.t.geometry.PointCloud.from_legacy(cloud) if tensor else cloud)
    torch.testing.assert_close(field.signed_distance(POINTS), POINTS.norm(dim=1) - 0.49, rtol=0, atol=0.02)


def test_a_grid_is_that_of_its_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "grid.npz", sdf=GRID, origin=np.full(3, -1.0), spacing=1 / 8)
    given = regnf.open_field(tmp_path / "grid.npz", cache_dir=tmp_path).signed_distance(POINTS)
    assert torch.equal(
        regnf.from_grid(torch.from_numpy(GRID), (-1, -1, -1), [1 / 8] * 3).signed_distance(POINTS), given
    )


def in_numpy(points: Tensor) -> Any:
    return np.linalg.norm(points.numpy(), axis=1) - 0.5


@pytest.mark.parametrize(
    ("function", "sign"),
    [
        (lambda points: points.norm(dim=1) - 0.5, 1),
        (lambda points: points.double().norm(dim=1, keepdim=True) - 0.5, 1),
        (lambda points: 0.5 - points.norm(dim=1), -1),
        (in_numpy, 1),
    ],
)
def test_a_function_is_a_field(function: Callable[[Tensor], Any], sign: int) -> None:
    field = regnf.from_function(function, CUBE, sign=sign)
    distance, gradient = field.signed_distance_and_gradient(POINTS.double())
    assert distance.dtype == gradient.dtype == torch.float32
    torch.testing.assert_close(distance, POINTS.norm(dim=1) - 0.5)
    torch.testing.assert_close(gradient, torch.nn.functional.normalize(POINTS, dim=1), rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("make", "reason", "says"),
    [
        (lambda: regnf.from_mesh(V, F + 1), "MESH_INVALID", "subtract 1"),
        (lambda: regnf.from_mesh(V, F - 1), "MESH_INVALID", "vertices -1 to"),
        (lambda: regnf.from_mesh(V.T, F), "MESH_INVALID", "vertices.T"),
        (lambda: regnf.from_mesh(V, F.T), "MESH_INVALID", "faces.T"),
        (lambda: regnf.from_mesh(V, F + 0.5), "MESH_INVALID", "not whole"),
        (lambda: regnf.from_mesh(V, F[:0]), "MESH_INVALID", "(0, 3)"),
        (lambda: regnf.from_mesh(V + 1j, F), "MESH_INVALID", "complex128"),
        (lambda: regnf.from_mesh([[0, 0, 0], [1]], F), "MESH_INVALID", "vertices"),
        (lambda: regnf.from_mesh(None, F), "MESH_INVALID", "nothing"),
        (lambda: regnf.from_mesh(V * np.nan, F), "MESH_INVALID", "finite"),
        (lambda: regnf.from_mesh(V * [1, 0, 0], F), "MESH_INVALID", "no triangle of the mesh has an area"),
        (lambda: regnf.from_points(V, sensor=(0, 0)), "MESH_INVALID", "three numbers"),
        (lambda: regnf.from_points(V, V[1:]), "MESH_INVALID", "161 normals for 162"),
        (lambda: regnf.from_grid(GRID[0], (0, 0, 0), 1), "TENSOR_SHAPE", "(17, 17)"),
        (lambda: regnf.from_grid(GRID * np.nan, (0, 0, 0), 1), "TENSOR_NOT_FINITE", "finite"),
        (lambda: regnf.from_grid(GRID, (0, 0), 1), "BOUNDS_INVALID", "origin"),
        (lambda: regnf.from_grid(GRID, (0, 0, 0), -1), "BOUNDS_INVALID", "spacing"),
        (lambda: regnf.from_grid(-GRID, (-1, -1, -1), 1 / 8), "FIELD_IMPLAUSIBLE", "sign"),
        (lambda: regnf.from_function(lambda _: 1 / 0, CUBE), "FUNCTION_UNUSABLE", "ZeroDivisionError"),
        (lambda: regnf.from_function(lambda _: None, CUBE), "FUNCTION_UNUSABLE", "NoneType"),
        (lambda: regnf.from_function(lambda p: p, CUBE), "FUNCTION_UNUSABLE", "shape"),
        (lambda: regnf.from_function(lambda p: p[:, 0] * np.nan, CUBE), "FIELD_NOT_FINITE", "NaN or infinity"),
        (lambda: regnf.from_function(lambda p: p.norm(dim=1) + 1, CUBE), "NO_ZERO_LEVEL", "bounds"),
        (lambda: regnf.from_function(lambda p: p[:, 0], CUBE[::-1]), "BOUNDS_INVALID", "corners"),
        (lambda: regnf.from_function(3, CUBE), "FUNCTION_UNUSABLE", "called"),  # type: ignore[arg-type]
        *(
            (lambda thing=thing: regnf.open_field(thing), "NO_FIELD", NAMES)
            for thing in (V, {"a": 1}, b"x", None, 3, torch.nn.Linear(3, 1), trimesh.Trimesh, [V, F])
        ),
        (lambda: regnf.register(BALL, {"a": 1}, BOX), "NO_FIELD", "the object is of the type dict"),
    ],
)
def test_what_is_no_field_is_refused_in_words(make: Callable[[], object], reason: str, says: str) -> None:
    with pytest.raises(regnf.RegnfError) as caught:
        make()
    assert caught.value.reason == reason
    assert says in f"{caught.value} {caught.value.hint}"


class Raycast:
    """A field of a user's own, strict about what it is given: Open3D's rays know float32 alone."""

    def __init__(self, mesh: Any) -> None:
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
        self.bounds = torch.tensor([[-1.2, -1.2, -0.5], [1.2, 1.2, 1.0]], dtype=torch.float64)
        self.device = torch.device("cpu")

    def to(self, device: torch.device | str) -> Raycast:
        del device
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        assert points.dtype == torch.float32
        return torch.from_numpy(self._scene.compute_signed_distance(points.numpy()).numpy())

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        steps = 1e-3 * torch.eye(3)
        slopes = [(self.signed_distance(points + h) - self.signed_distance(points - h)) / 2e-3 for h in steps]
        return self.signed_distance(points), torch.stack(slopes, dim=-1)


def thing() -> trimesh.Trimesh:
    seat, back = trimesh.creation.box((0.5, 0.4, 0.1)), trimesh.creation.box((0.1, 0.4, 0.5))
    knob = trimesh.creation.box((0.1, 0.1, 0.2))
    return trimesh.util.concatenate(
        [seat, back.apply_translation((0.2, 0.0, 0.3)), knob.apply_translation((-0.2, 0.1, 0.15))]
    )


@pytest.mark.parametrize("own", [False, True])
def test_objects_of_other_libraries_are_registered_with_a_box_from_a_file(own: bool, tmp_path: Path) -> None:
    room = trimesh.util.concatenate(
        [
            thing().apply_translation((0.1, 0.2, 0.0)),
            trimesh.creation.box((2.0, 2.0, 0.1)).apply_translation((0, 0, -0.11)),
        ]
    )
    scene: Any = room
    if own:
        scene = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(room.vertices), open3d.utility.Vector3iVector(room.faces)
        )
        scene = Raycast(scene)
    box = {"min": [-0.25, -0.1, -0.1], "max": [0.45, 0.5, 0.65]}
    (tmp_path / "box.json").write_text("\ufeff" + json.dumps(box), encoding="utf-8")
    found = regnf.register(scene, thing(), tmp_path / "box.json", {"up_axis": "z"})
    assert found.verdict == "registered"
    np.testing.assert_allclose(found.T_scene_object.translation.numpy(), [0.1, 0.2, 0.0], atol=2e-3)


def test_a_box_s_file_is_read_or_said_why_not(tmp_path: Path) -> None:
    (tmp_path / "box.json").write_text("{'min': 3}")
    for box, reason in ((tmp_path / "box.json", "MALFORMED_JSON"), ("absent.json", "FILE_NOT_FOUND")):
        with pytest.raises(regnf.RegnfError) as caught:
            regnf.register(BALL, BALL, box)
        assert caught.value.reason == reason


@pytest.mark.parametrize(
    "ask",
    [
        lambda room, cloud, box: regnf.register(room, cloud, box),
        lambda room, cloud, box: regnf.register(cloud, room, box),
        lambda room, cloud, box: regnf.register(room, {"points": cloud}, box),
        lambda room, cloud, box: regnf.search(room, [cloud], box),
    ],
)
def test_what_is_refused_is_refused_before_a_large_file_is_imported(
    ask: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imported: list[str] = []

    def of_file(source: Any, cache_dir: Path) -> Any:
        imported.append(source.file.name)
        return import_(source, cache_dir)

    import_ = loading._imported
    monkeypatch.setattr(loading, "_imported", of_file)
    BALL.export(tmp_path / "room.ply")
    open3d.io.write_point_cloud(
        str(tmp_path / "cloud.ply"), open3d.geometry.PointCloud(open3d.utility.Vector3dVector(V[:20]))
    )
    with pytest.raises(regnf.RegnfError) as caught:
        ask(tmp_path / "room.ply", tmp_path / "cloud.ply", BOX)
    assert caught.value.reason in ("POINT_CLOUD_TOO_SMALL", "NO_FIELD")
    assert "room.ply" not in imported
