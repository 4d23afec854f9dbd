"""Rendered images against projections worked out by hand, and against exact distances."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks.worlds.mesh_scene import (
    MeshScene,
    PaintedMesh,
    Thing,
    box_thing,
    paint_of,
    tile_paint,
    to_linear,
    to_srgb,
)
from benchmarks.worlds.rendering import intrinsics_of, light, render
from regnf_core.fields.mesh import MeshField

SIZE = (120, 160)
WHITE = tile_paint((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), 1.0)
ALONG_Y = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -3.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""A level camera 3 m before the origin, looking along y."""


def cube() -> MeshScene:
    """A box of 1 x 2 x 1 m about the origin: its front is 2 m before the camera."""
    return MeshScene([box_thing([-0.5, -1.0, -0.5], [0.5, 1.0, 0.5], WHITE)])


def test_depth_and_corners_of_a_box() -> None:
    # Focal length 80 / tan 30 degrees = 138.564: the front's corner (.5, -1, .5) falls on (114.641, 25.359).
    view = render(cube(), SIZE, intrinsics_of(SIZE, 60.0), ALONG_Y)
    assert view.depth[25:95, 45:115].shape == (70, 70)
    np.testing.assert_allclose(view.depth[25:95, 45:115], 2.0, atol=1e-6)
    assert (view.thing[25:95, 45:115] == 0).all()
    outside = np.ones(SIZE, dtype=bool)
    outside[25:95, 45:115] = False
    assert (view.depth[outside] == 0.0).all()
    assert (view.thing[outside] == -1).all()
    # The middle of pixel (60, 80) is off the axis by half a pixel both ways.
    assert view.cosine[60, 80] == pytest.approx(138.5641 / np.sqrt(138.5641**2 + 0.5), abs=1e-6)


def test_light_follows_lamberts_law() -> None:
    lamp = np.array([0.5, 0.35, 0.8]) / np.sqrt(0.5**2 + 0.35**2 + 0.8**2)
    normals = np.array([lamp, -lamp, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    ambient = 0.45 * (0.8 + 0.2 * normals[:, 2])
    shone = 0.55 * np.array([1.0, 0.0, lamp[2], lamp[0]])
    np.testing.assert_allclose(light(normals), ambient + shone)
    view = render(cube(), SIZE, intrinsics_of(SIZE, 60.0), ALONG_Y)
    assert (view.colors[60, 80] == to_srgb(np.array([0.45 * 0.8]))).all()  # its front faces away from the lamp
    assert (view.colors[0, 0] == 255).all()


def test_colors_are_the_mean_of_a_pixels_rays() -> None:
    # The upper edge falls on row 25.359: of three rows of rays at 25.167, .5 and .833 two meet the box.
    black = tile_paint((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
    scene = MeshScene([box_thing([-0.5, -1.0, -0.5], [0.5, 1.0, 0.5], black)])
    view = render(scene, SIZE, intrinsics_of(SIZE, 60.0), ALONG_Y)
    assert (view.colors[25, 80] == to_srgb(np.array([1.0 / 3.0]))).all()


def test_a_texture_lies_the_right_way_up() -> None:
    picture = Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], dtype=np.uint8))
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    mesh.visual = trimesh.visual.TextureVisuals(
        uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    )
    loaded = trimesh.load_mesh(trimesh.util.wrap_as_stream(mesh.export(file_type="glb")), file_type="glb")
    for each in (mesh, loaded):
        paint = paint_of(each)
        solid = MeshField(each.vertices, each.faces)
        scene = MeshScene([Thing((PaintedMesh(solid.vertices, solid.faces, paint),), solid)])
        origins = np.array([[x, y, 1.0] for y, x in product((0.75, 0.25), (0.25, 0.75))])
        hits = scene.cast(origins, np.tile([0.0, 0.0, -1.0], (4, 1)))
        np.testing.assert_array_equal(hits.color, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])


def test_srgb_there_and_back() -> None:
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(to_srgb(to_linear(every)), every)
    assert to_linear(np.array([188]))[0] == pytest.approx(0.503, abs=1e-3)  # the well-known middle gray of light
