"""Meshes by compiled code: against Open3D's closest points, the exact winding number, and libigl's answers."""

from __future__ import annotations

from typing import Any

import igl
import numpy as np
import open3d
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.fields.build import ScaledField
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.mesh import MeshField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native.steps import native_model
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.working_frame import WorkingField, WorkingFrame
from tests.core.fields.test_mesh_kind import blade
from tests.core.robust.test_compiled_steps import assert_alike, plainly, poses, samples  # noqa: F401

Array = NDArray[np.float64]


def without(mesh: trimesh.Trimesh, gone: NDArray[np.bool_]) -> trimesh.Trimesh:
    mesh.update_faces(~gone)
    return mesh


def open_ball() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(4)
    return without(ball, ball.triangles_center[:, 2] > 0.3)


def overlapping() -> trimesh.Trimesh:
    parts = [trimesh.creation.box([2, 1, 1]), trimesh.creation.box([1, 2, 1]), trimesh.creation.icosphere(4, 0.7)]
    return trimesh.util.concatenate(parts)


def inside_out() -> trimesh.Trimesh:
    """One part within the other and one beside it face inward."""
    outer, hollow, beside = trimesh.creation.icosphere(3), trimesh.creation.icosphere(3, 0.5), trimesh.creation.box()
    beside.apply_translation([2.0, 0.1, 0.0])
    for one in (hollow, beside):
        one.invert()
    return trimesh.util.concatenate([outer, hollow, beside])


def raw(vertices: Any, faces: Any) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def degenerate() -> trimesh.Trimesh:
    """Triangles that are a line or a point, one twice, and vertices at one place or of no triangle."""
    vertices = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 1], [0, 0, 0], [50, 50, 50]]
    faces = [[0, 1, 2], [0, 0, 0], [5, 1, 3], [1, 1, 3], [2, 3, 4], [2, 3, 4], [0, 5, 4]]
    return raw(np.array(vertices, float), faces)


def soup() -> trimesh.Trimesh:
    numbers = np.random.default_rng(5)
    return raw(numbers.normal(size=(500, 3)), numbers.integers(0, 500, (400, 3)))


def large() -> trimesh.Trimesh:
    """200,000 triangles less some."""
    ring = trimesh.creation.torus(1.0, 0.3, major_sections=400, minor_sections=250)
    return without(ring, np.random.default_rng(6).random(len(ring.faces)) < 0.02)


MESHES = {
    "closed": lambda: trimesh.creation.icosphere(3),
    "wedge": blade,
    "open": open_ball,
    "overlapping": overlapping,
    "inside out": inside_out,
    "one triangle": lambda: raw(np.eye(3), [[0, 1, 2]]),
    "degenerate": degenerate,
    "soup": soup,
    "large": large,
}


def places(field: MeshField, count: int) -> Array:
    """(count, 3): half of them all over, half near the surface."""
    numbers = np.random.default_rng(1)
    low, high = field.bounds.numpy()
    near = field.sample_surface(count // 2, numbers)
    near += numbers.normal(size=near.shape) * np.ptp(near) * np.geomspace(1e-4, 0.1, len(near))[:, None]
    return np.concatenate([numbers.uniform(low - 0.3, high + 0.3, near.shape), near])


@pytest.mark.parametrize("name", [name for name in MESHES if name != "degenerate"])  # Open3D leaves lines out
def test_distances_and_sides(name: str, plainly: Any) -> None:  # noqa: F811
    mesh = MESHES[name]()
    field = MeshField(mesh.vertices, mesh.faces)
    size = float(np.ptp(field.bounds.numpy(), axis=0).max())
    points = places(field, 200 if name == "large" else 3000)
    distance, gradient = (one.numpy() for one in field.signed_distance_and_gradient(torch.from_numpy(points)))
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    closest = scene.compute_closest_points(points.astype(np.float32))["points"].numpy()
    exact = np.linalg.norm(points - closest, axis=1)
    np.testing.assert_allclose(np.abs(distance), exact, rtol=0, atol=1e-5 * size)
    tree = field._tree()
    assert tree is not None
    number = igl.winding_number(field.vertices, field.faces, points)  # the exact one
    np.testing.assert_allclose(tree.winding_number(points), number, rtol=0, atol=0.015)
    clear = np.abs(number - 0.5) > 0.05
    assert clear.mean() > 0.7
    np.testing.assert_array_equal((distance < 0.0)[clear], (number > 0.5)[clear])
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, rtol=0, atol=1e-6)
    found = points - distance[:, None] * gradient  # the closest point: other ones are as close
    again = scene.compute_distance(found.astype(np.float32)).numpy()
    assert again.max() < 1e-5 * size


@pytest.mark.parametrize("name", [name for name in MESHES if name != "large"])
def test_libigl_says_the_same(name: str, plainly: Any) -> None:  # noqa: F811
    mesh = MESHES[name]()
    field, other = MeshField(mesh.vertices, mesh.faces), MeshField(mesh.vertices, mesh.faces)
    points = torch.from_numpy(places(field, 1000))
    found, expected = field.signed_distance_and_gradient(points), plainly(other.signed_distance_and_gradient, points)
    assert (field._normals is None) == (other._normals is None) == (name not in ("closed", "wedge"))
    number = igl.winding_number(field.vertices, field.faces, points.numpy())
    clear = torch.from_numpy(np.abs(number - 0.5) > 0.05)
    torch.testing.assert_close(found[0][clear], expected[0][clear], rtol=1e-6, atol=1e-7)
    apart = (found[1][clear] - expected[1][clear]).norm(dim=1) > 1e-4
    assert apart.float().mean() < 0.01, "but where two places are as close"


def test_the_hierarchy_holds_each_triangle_once() -> None:
    for count in (1, 7, 8, 9, 16, 17, 63, 64, 65, 129, 513):
        numbers = np.random.default_rng(count)
        field = MeshField(numbers.normal(size=(count + 2, 3)), np.arange(count)[:, None] + np.arange(3))
        tree = field._tree()
        if tree is None:
            pytest.skip("there is no compiled code")
        order = tree._arrays["order"].view(-1).numpy()
        np.testing.assert_array_equal(np.sort(order[:count]), np.arange(count))
        points = numbers.normal(size=(50, 3))
        each = [MeshField(field.vertices, field.faces[[i]])._closest(points)[0] for i in range(count)]
        np.testing.assert_allclose(tree.closest(points)[0], np.min(each, axis=0), rtol=1e-12)


def test_on_the_surface_the_gradient_is_the_normal(plainly: Any) -> None:  # noqa: F811
    for mesh in (trimesh.creation.icosphere(2), open_ball()):
        field = MeshField(mesh.vertices, mesh.faces)
        distance, gradient = field.signed_distance_and_gradient(torch.tensor(mesh.triangles_center))
        np.testing.assert_allclose(distance, 0.0, atol=1e-9)
        np.testing.assert_allclose(gradient, mesh.face_normals, atol=1e-6)
        corners = field.signed_distance(torch.from_numpy(field.vertices[np.unique(field.faces)]))
        np.testing.assert_allclose(corners, 0.0, atol=1e-9)
    line = MeshField([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])
    assert line.signed_distance_and_gradient(torch.tensor([[0.5, 0.0, 0.0]]))[1].tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("mesh", [trimesh.creation.icosphere(2), open_ball()])
def test_any_unit_and_any_distance(mesh: trimesh.Trimesh, scale: float, plainly: Any) -> None:  # noqa: F811
    given = mesh.vertices * scale, mesh.faces
    points = torch.tensor([[0.1, 0.2, -0.3], [0.9, 0.9, 0.1], [1e3, 0, 0], [1e12, 1e3, 0], [-1e7, 0, 1e7]]).double()
    found = MeshField(*given).signed_distance_and_gradient(points * scale)
    expected = plainly(MeshField(mesh.vertices, mesh.faces).signed_distance_and_gradient, points)
    torch.testing.assert_close(found[0].double() / scale, expected[0].double(), rtol=1e-5, atol=1e-6)
    if scale > 1e-9:  # else all is on the surface
        torch.testing.assert_close(found[1], expected[1], rtol=0, atol=1e-6)


def test_a_place_that_is_not_finite_has_no_distance(plainly: Any) -> None:  # noqa: F811
    field = MeshField(*(getattr(open_ball(), part) for part in ("vertices", "faces")))
    nan, inf = float("nan"), float("inf")
    points = torch.tensor([[0.0, nan, 0.0], [inf, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -inf, inf]])
    distance, gradient = field.signed_distance_and_gradient(points)
    assert distance.isnan().tolist() == [True, True, False, True]
    assert gradient.isnan().all(1).tolist() == [True, True, False, True]


def test_neighbors_and_threads_change_nothing(plainly: Any) -> None:  # noqa: F811
    mesh = overlapping()
    field = MeshField(mesh.vertices, mesh.faces)
    points = torch.from_numpy(places(field, 20_000))
    points[::3] = torch.from_numpy(field.sample_surface(len(points[::3]), np.random.default_rng(2)))
    together = field.signed_distance_and_gradient(points)
    turned = field.signed_distance_and_gradient(points.flip(0))
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        parted = field.signed_distance_and_gradient(points)
    finally:
        torch.set_num_threads(threads)
    for one, other, third in zip(together, turned, parted, strict=True):
        assert torch.equal(one, other.flip(0))
        assert torch.equal(one, third)


FAR = np.array([500_000.0, -4_000_000.0, 120.0])


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("make", [lambda: trimesh.creation.icosphere(3), overlapping])
def test_compiled_code_asks_a_mesh_itself(make: Any, far: bool, plainly: Any) -> None:  # noqa: F811
    """Through transforms and units, also far from the origin, as residuals and in a minimization."""
    mesh = make()
    T = Sim3.from_quaternion(0.5, [0.1, 0.2, -0.3, 1.0], [0.1, -0.2, 0.3])
    frame = WorkingFrame(torch.tensor([0.1, 0.0, -0.1], dtype=torch.float64), 1.3)
    numbers = torch.Generator().manual_seed(8)
    scene, obj, start = samples(90, numbers), samples(60, numbers), poses(4, numbers)

    def pair_at(place: Array) -> SurfacePair:
        field = MeshField(0.4 * mesh.vertices + place, mesh.faces)
        there = TransformedField(field, Sim3.from_translation(torch.from_numpy(place)))
        working = WorkingField(ScaledField(TransformedField(there, T), 2.0), frame)
        assert native_model(working) is not None
        return SurfacePair(working, working, scene, obj, 0.0)

    pair, same = pair_at(FAR if far else np.zeros(3)), pair_at(np.zeros(3))  # libigl errs far from the origin
    assert_alike(residuals(pair, start), plainly(residuals, same, start), atol=1e-5)
    found, expected = minimize(pair, start, (0.2, 0.1)), plainly(minimize, same, start, (0.2, 0.1))
    torch.testing.assert_close(found.scores, expected.scores, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.T.translation, expected.T.translation, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.T.rotation, expected.T.rotation, rtol=0, atol=1e-4)


def test_without_compiled_code_a_mesh_is_asked_in_python(plainly: Any) -> None:  # noqa: F811
    field = MeshField(*(getattr(open_ball(), part) for part in ("vertices", "faces")))
    assert native_model(field) is not None
    assert plainly(native_model, field) is None
    assert plainly(field._tree) is None
