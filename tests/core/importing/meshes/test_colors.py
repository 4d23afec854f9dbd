"""Colors of a mesh's vertices, in every format that has them, and at any point of the field."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.fields.observation import has_color
from tests.core.importing.meshes.mesh_files import BALL, FACES, converted, field_of

PAINT = np.random.default_rng(3).integers(0, 256, (len(BALL.vertices), 3))
"""R, G, B of the ball's vertices, up to 255."""


def painted() -> trimesh.Trimesh:
    ball = BALL.copy()
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=np.column_stack((PAINT, np.full(len(PAINT), 255))))
    return ball


def ply(kind: str = "uchar", top: float = 255.0) -> bytes:
    """BALL as text, colors as numbers of ``kind`` up to ``top``."""
    head = f"ply\nformat ascii 1.0\nelement vertex {len(PAINT)}\n"
    head += "".join(f"property float {name}\n" for name in "xyz")
    head += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    head += f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nend_header\n"
    whole = kind != "float"
    colors = (PAINT / 255.0 * top).round().astype(int) if whole else PAINT / 255.0 * top
    rows = [" ".join(map(repr, [*p, *c])) for p, c in zip(BALL.vertices.tolist(), colors.tolist(), strict=True)]
    return (head + "\n".join([*rows, *(f"3 {a} {b} {c}" for a, b, c in FACES)]) + "\n").encode()


def obj(top: float) -> bytes:
    rows = [
        "v " + " ".join(map(repr, [*place, *color]))
        for place, color in zip(BALL.vertices.tolist(), (PAINT / 255.0 * top).tolist(), strict=True)
    ]
    return "\n".join([*rows, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES)]).encode()


def color_at(field: Any, points: NDArray[np.float64]) -> NDArray[np.float32]:
    places = torch.from_numpy(points).float()
    found: NDArray[np.float32] = field.color(places, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(places), 3)).numpy()
    return found


FILES = {
    "ply": ply(),
    "ply of shorts": ply("ushort", 65535.0),
    "ply of floats": ply("float", 1.0),
    "binary ply": bytes(painted().export(file_type="ply")),
    "obj": obj(1.0),
    "obj up to 255": obj(255.0),
}


@pytest.mark.parametrize("data", FILES.values(), ids=FILES.keys())
def test_vertices_have_the_colors_of_the_file(data: bytes) -> None:
    field = field_of(converted(data))
    assert has_color(field)
    np.testing.assert_allclose(color_at(field, BALL.vertices), PAINT / 255.0, rtol=0, atol=1e-3)


def test_gltf_has_linear_light() -> None:
    """A color of 0.2140 of full light is 0.5 in an image (IEC 61966-2-1)."""
    linear = np.full_like(PAINT, round(0.2140 * 255))
    ball = BALL.copy()
    ball.visual = trimesh.visual.ColorVisuals(ball, vertex_colors=np.column_stack((linear, np.full(len(PAINT), 255))))
    found = color_at(field_of(converted(ball.export(file_type="glb"))), BALL.vertices)
    np.testing.assert_allclose(found, 0.5, rtol=0, atol=4e-3)


def test_gltf_has_the_color_of_a_material() -> None:
    ball = BALL.copy()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    ball.visual = trimesh.visual.TextureVisuals(material=material)
    found = color_at(field_of(converted(ball.export(file_type="glb"))), BALL.vertices)
    np.testing.assert_allclose(found, [[1.0, 0.0, 0.0]] * len(found), rtol=0, atol=1e-3)


def test_between_vertices_and_off_the_surface_the_closest_point_counts() -> None:
    field = field_of(converted(ply()))
    corners = BALL.vertices[BALL.faces[7]]
    shares = np.array([0.2, 0.5, 0.3])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    point = shares @ corners + 0.01 * normal / np.linalg.norm(normal)
    expected = shares @ (PAINT[BALL.faces[7]] / 255.0)
    np.testing.assert_allclose(color_at(field, point[None])[0], expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    "data",
    [
        ply().replace(b"property uchar blue", b"property uchar violet"),
        b"\n".join([line[: line.rfind(b" ")] if line.startswith(b"v") else line for line in obj(1.0).splitlines()]),
    ],
)
def test_a_mesh_without_three_numbers_a_vertex_has_no_color(data: bytes) -> None:
    assert not has_color(field_of(converted(data)))


def test_colors_change_nothing_about_the_distance() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    colored, plain = field_of(converted(ply())), field_of(converted(ply(), color={"keep": False}))
    assert not has_color(plain)
    for one, other in zip(
        colored.signed_distance_and_gradient(points), plain.signed_distance_and_gradient(points), strict=True
    ):
        assert torch.equal(one, other)
