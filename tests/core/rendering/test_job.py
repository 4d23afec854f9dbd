"""A whole rendering: requests that are refused, files that are written, work that is stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from regnf_core import Sim3, open_field
from regnf_core.errors import CancelledError, RegnfError
from regnf_core.fields.observation import SdfField
from regnf_core.rendering.job import run_render
from regnf_core.rendering.request import RenderRequest
from tests.core.analytic import AnalyticField, boxes, sphere

T = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.25], [0.0, 0.0, 0.0, 1.0]]
BALL = {"kind": "insertion", "object": "ball", "T_object_scene": T, "tint": [0.9, 0.2, 0.1]}
ASIDE = BALL | {"T_object_scene": [[1.0, 0.0, 0.0, 0.5], *T[1:]]}
SMALL: dict[str, Any] = {"edits": [BALL, ASIDE], "size": [32, 24], "orbit": {"frames": 2}}


def room() -> AnalyticField:
    return boxes([([-1.0, -1.0, -0.1], [1.0, 1.0, 0.0])], [[-1.0, -1.0, -0.1], [1.0, 1.0, 1.0]])


def ball(name: str) -> SdfField:
    assert name == "ball"
    return sphere(0.25, bounds=[[-0.4] * 3, [0.4] * 3])


def test_every_file_is_what_the_report_says(tmp_path: Path) -> None:
    outputs = ["color", "depth", "normal", "animation", "strip", "mesh", "field"]
    values = SMALL | {"outputs": outputs, "mesh_resolution": 24, "field_resolution": 24}
    told: list[float] = []
    report = run_render(room(), RenderRequest.from_dict(values), ball, tmp_path, told.append)
    assert {one.name for one in report.artifacts} == {path.name for path in tmp_path.iterdir()}
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert json.loads((tmp_path / "render.json").read_text())["depth_unit"] == report.depth_unit
    depth = np.load(tmp_path / "frame-0001-depth.npy")
    levels = np.array(Image.open(tmp_path / "frame-0001-depth.png"))
    assert depth.shape == levels.shape == (24, 32)
    assert np.abs(levels * report.depth_unit - depth).max() <= report.depth_unit
    with Image.open(tmp_path / "animation.webp") as animation:
        assert animation.n_frames == 2
    colors = trimesh.load(tmp_path / "composite.glb", force="mesh").visual.vertex_colors
    assert (colors[:, 0].astype(int) - colors[:, 1] > 100).mean() > 0.1
    again = open_field(tmp_path / "edited.safetensors")
    assert float(again.signed_distance(torch.tensor([[0.0, 0.0, 0.25]]))[0]) < -0.1
    assert float(again.signed_distance(torch.tensor([[0.7, 0.7, 0.5]]))[0]) > 0.1


def test_an_orbit_through_a_pillar_shows_what_it_goes_round(tmp_path: Path) -> None:
    # The camera of the orbit is at x = 1, inside of the pillar; its own place, given as such, is refused.
    solid = [([-2.0, -2.0, -0.1], [2.0, 2.0, 0.0]), ([0.6, -0.5, 0.0], [1.6, 0.5, 1.0])]
    scene = boxes(solid, [[-2.0, -2.0, -0.1], [2.0, 2.0, 1.0]])
    values = {"edits": [BALL], "outputs": ["depth"], "before": False, "size": [41, 31]}
    orbit = {"frames": 1, "elevation_deg": 0.0, "distance": 1.0}
    run_render(scene, RenderRequest.from_dict(values | {"orbit": orbit}), ball, tmp_path)
    assert abs(np.load(tmp_path / "frame-0000-depth.npy")[15, 20] - 0.75) < 0.01
    place = {"position": [1.0, 0.0, 0.25], "target": [0.0, 0.0, 0.25]}
    with pytest.raises(RegnfError) as caught:
        run_render(scene, RenderRequest.from_dict(values | {"look_at": [place]}), ball, tmp_path)
    assert caught.value.reason == "CAMERA_INVALID"


def test_cameras_of_poses_and_places(tmp_path: Path) -> None:
    poses = [{"T_scene_camera": _pose(), "intrinsics": [40.0, 40.0, 20.5, 15.5], "size": [41, 31]}]
    places = [{"position": [0, -2, 0.4], "target": [0, 0, 0.4]}]
    for number, cameras in enumerate(({"poses": poses}, {"look_at": places, "size": [41, 31]})):
        folder = tmp_path / str(number)
        folder.mkdir()
        request = RenderRequest.from_dict({"edits": [BALL], **cameras, "outputs": ["depth"], "before": False})
        run_render(room(), request, ball, folder)
        depth = np.load(folder / "frame-0000-depth.npy")
        height, width = depth.shape
        assert abs(depth[height // 2, width // 2] - 1.8) < 0.01  # 2 less the ball's half width at .4
        assert not (folder / "before-0000-depth.npy").exists()


def _pose() -> list[list[float]]:
    """From (0, -2, .4) along y, OpenCV's axes."""
    return [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -2.0], [0.0, -1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]


def test_cancelling_ends_the_work(tmp_path: Path) -> None:
    calls: list[float] = []

    def tell(share: float) -> None:
        calls.append(share)
        if len(calls) > 4:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        run_render(room(), RenderRequest.from_dict(SMALL), ball, tmp_path, tell)


@pytest.mark.parametrize(
    ("reason", "values"),
    [
        ("RENDER_TOO_LARGE", {"orbit": {"frames": 1_000_000}}),
        ("RENDER_TOO_LARGE", {"size": [100_000, 10_000]}),
        ("RENDER_TOO_LARGE", {"size": [4096, 4096], "orbit": {"frames": 2000}}),
        ("CAMERA_INVALID", {"orbit": {"frames": 0}}),
        ("CAMERA_INVALID", {"orbit": {"edit": 3}}),
        ("CAMERA_INVALID", {"orbit": {}, "look_at": [{"position": [0, 0, 1], "target": [0, 0, 0]}]}),
        ("CAMERA_INVALID", {"look_at": []}),
        ("CAMERA_INVALID", {"look_at": [{"position": [0, 0, float("nan")], "target": [0, 0, 0]}]}),
        ("INVALID_OPTIONS", {"options": {"mode": "fast"}}),
        ("INVALID_OPTIONS", {"option": {}}),
        ("INVALID_OPTIONS", {"outputs": ["film"]}),
        ("EDIT_INVALID", {"edits": {}}),
        ("EDIT_INVALID", {"edits": [BALL] * 65}),
        ("EDIT_INVALID", {"edits": [{"kind": "paint"}]}),
        ("EDIT_INVALID", {"edits": [{"kind": "removal"}]}),
        ("EDIT_INVALID", {"edits": [BALL | {"tint": [2, 0, 0]}]}),
        ("EDIT_INVALID", {"edits": [BALL | {"object": "a\nb"}]}),
        ("INVALID_TRANSFORM", {"edits": [BALL | {"T_object_scene": [[2, 0, 0, 0], *T[1:]]}]}),
        ("INVALID_TRANSFORM", {"edits": [BALL | {"T_object_scene": "result"}]}),
        ("INVALID_DETECTION", {"edits": [{"kind": "removal", "detection": {"center": [0, 0, 0], "size": [-1, 1, 1]}}]}),
    ],
)
def test_bad_requests_have_reasons(reason: str, values: dict[str, Any]) -> None:
    with pytest.raises(RegnfError) as caught:
        RenderRequest.from_dict(values)
    assert caught.value.reason == reason


def test_a_request_reads_what_registrations_write() -> None:
    transform = Sim3.from_matrix(T).to_dict()
    request = RenderRequest.from_dict({"edits": [BALL | {"T_object_scene": transform}]})
    assert request.edits[0].T_object_scene == T
    assert request.frames == 8
    assert request.rendered_pixels == 2 * 8 * 480 * 360
