"""The result document and the artifacts, read back with other tools than wrote them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from regnf_core.document import (
    Alternative,
    CameraView,
    Candidate,
    DecidingSurface,
    Difference,
    ObjectSymmetry,
    ResultDocument,
    ranking_document,
    result_document,
)
from regnf_core.errors import VERDICT_REASONS
from regnf_core.geometry.sim3 import Sim3
from regnf_core.viewing.artifacts import write_artifacts
from regnf_core.viewing.difference_panel import Deciding
from regnf_core.viewing.registration_picture import stored_picture
from regnf_core.viewing.splats import Surfels, View, nearest_surfels, paint, paint_half, render
from tests.core.conftest import ChairRun
from tests.core.fields.native_builds import variants

NAMES = [
    "scene_points.ply", "object_points.ply", "aligned.ply", "residuals.npz", "context_points.ply", "preview.png",
    "trace.json", "T_scene_object.npy", "result.json",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(chair_run: ChairRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("artifacts")
    assert write_artifacts(chair_run.result, path, truth=chair_run.truth) == NAMES
    assert sorted(each.name for each in path.iterdir()) == sorted(NAMES)
    return path


def test_the_document_is_json_and_says_everything(chair_run: ChairRun) -> None:
    document = json.loads(json.dumps(result_document(chair_run.result, chair_run.truth), allow_nan=False))
    of_the_service = {"artifacts", "missing_artifacts"}  # their addresses are known there alone
    assert set(document) == set(ResultDocument.model_fields) - of_the_service
    forth, back = (np.array(document[name]["matrix"]) for name in ("T_object_scene", "T_scene_object"))
    np.testing.assert_allclose(forth @ back, np.eye(4), atol=1e-9)
    assert document["metrics"]["rotation_error_rad"] < 0.02
    assert document["verdict_detail"] == VERDICT_REASONS["SURFACES_AGREE"]
    assert [document[name] for name in ("covariance", "covariance_ordering", "uncertainty", "symmetry")] == [None] * 4
    assert document["engine"]["name"] == "regnf"
    assert "rotation_error_rad" not in result_document(chair_run.result)["metrics"]


def test_numbers_that_json_lacks_become_null(chair_run: ChairRun) -> None:
    other = Alternative(Sim3.identity(), 0.5, "180 degrees about z")
    odd = replace(
        chair_run.result,
        metrics={"residual_rms": float("nan")},
        alternatives=[other],
        covariance=torch.eye(7),
        symmetry=ObjectSymmetry(2, (0.0, 0.0, 1.0), True),
    )
    document = result_document(odd)
    assert document["metrics"] == {"residual_rms": None}
    assert document["alternatives"][0]["relation"] == "180 degrees about z"
    assert document["alternatives"][0]["T_scene_object"]["matrix"] == np.eye(4).tolist()
    assert len(document["covariance"]) == 7
    assert document["symmetry"] == {"order": 2, "axis": [0.0, 0.0, 1.0], "continuous": True}
    json.dumps(document, allow_nan=False)


def test_uncertainty_is_the_covariance_in_units_of_people(chair_run: ChairRun) -> None:
    degree, unit, percent = math.radians(1.0), 0.25, 0.01
    variances = [degree**2, (2 * degree) ** 2, (3 * degree) ** 2, unit**2, 4 * unit**2, 0.0, percent**2]
    document = result_document(replace(chair_run.result, covariance=torch.tensor(variances).double().diag()))
    assert document["covariance_ordering"] == ["omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s"]
    assert document["uncertainty"]["rotation_deg"] == pytest.approx([1.0, 2.0, 3.0])
    assert document["uncertainty"]["scale_percent"] == pytest.approx(1.0)


def test_what_is_no_variance_has_no_deviation(chair_run: ChairRun) -> None:
    odd = torch.diag(torch.tensor([-1.0, math.nan, 1.0, math.inf, 1.0, 1.0, -1e-9]).double())
    document = json.loads(json.dumps(result_document(replace(chair_run.result, covariance=odd)), allow_nan=False))
    assert document["uncertainty"]["rotation_deg"][:2] == [None, None]
    assert document["uncertainty"]["center_scene"] == [None] * 3
    assert document["uncertainty"]["scale_percent"] is None
    assert document["covariance"][1][1] is None


def test_a_ranking_is_told_with_what_is_unusable_last() -> None:
    ranking = [
        Candidate("chair", "refined", 0.02, "registered", "SURFACES_AGREE", Sim3.identity(), 0.9, "default"),
        Candidate("stool", "coarse", math.inf),
    ]
    chair, stool, air = json.loads(json.dumps(ranking_document(ranking, {"air": "NO_SURFACE_IN_OBJECT"})))
    assert chair["T_object_scene"]["matrix"] == chair["T_scene_object"]["matrix"] == np.eye(4).tolist()
    assert (chair["probability"], chair["level"]) == (0.9, "default")
    assert (chair["object"], chair["verdict"], chair["verdict_reason"]) == ("chair", "registered", "SURFACES_AGREE")
    assert stool == {
        "object": "stool", "stage": "coarse", "score": None, "verdict": None, "verdict_reason": None,
        "probability": None, "level": None, "difference": None, "T_scene_object": None, "T_object_scene": None,
    }  # fmt: skip
    assert (air["object"], air["stage"], air["verdict_reason"]) == ("air", "unusable", "NO_SURFACE_IN_OBJECT")
    assert set(air) == set(stool)


def test_clouds_come_back_through_another_reader(chair_run: ChairRun, folder: Path) -> None:
    result = chair_run.result
    scene = trimesh.load(folder / "scene_points.ply")
    np.testing.assert_allclose(scene.vertices, result.scene_samples.points.numpy(), atol=1e-6)
    assert scene.colors.shape[0] == len(scene.vertices)
    aligned = trimesh.load(folder / "aligned.ply")
    count = len(result.scene_samples.points)
    assert len(aligned.vertices) == count + len(result.object_samples.points)
    assert len(np.unique(aligned.colors[:, :3], axis=0)) == 2
    placed = result.T_object_scene.inverse().apply(result.object_samples.points.double()).numpy()
    np.testing.assert_allclose(aligned.vertices[count:], placed, atol=1e-6)
    header = (folder / "object_points.ply").read_bytes().split(b"end_header\n")[0]
    assert b"format binary_little_endian 1.0" in header
    assert all(f"property float {name}".encode() in header for name in ("nx", "ny", "nz"))


def test_residuals_trace_and_transform_come_back(chair_run: ChairRun, folder: Path) -> None:
    result = chair_run.result
    with np.load(folder / "residuals.npz") as arrays:
        assert set(arrays) == {"scene_points", "scene_residuals", "object_points", "object_residuals"}
        assert arrays["scene_points"].shape == (len(arrays["scene_residuals"]), 3)
    np.testing.assert_allclose(np.load(folder / "T_scene_object.npy"), result.T_scene_object.matrix().numpy())
    trace = json.loads((folder / "trace.json").read_text())
    assert len(trace) == len(result.trace)
    assert np.array(trace[-1]["T_object_scene"]["matrix"]).shape == (4, 4)
    assert {"iteration", "loss", "residual_scene", "residual_object", "kernel_shape"} <= set(trace[0])
    assert json.loads((folder / "result.json").read_text())["verdict"] == result.verdict


def test_the_picture_shows_both_surfaces_and_small_residuals(folder: Path) -> None:
    with Image.open(folder / "preview.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape[1] == 3 * 480
    after, residual = pixels[60:, 480:960], pixels[60:, 960:]
    bluish = (after[..., 2] - after[..., 0] > 30).sum()
    orange = (after[..., 0] - after[..., 2] > 30).sum()
    assert min(bluish, orange) > 2000
    yellow = (residual[..., 0] > 180) & (residual[..., 2] < 100)
    assert yellow.sum() < 0.02 * (residual.sum(-1) < 600).sum()


def test_the_picture_can_be_drawn_of_the_stored_files(folder: Path) -> None:
    with Image.open(folder / "preview.png") as first, Image.open(BytesIO(stored_picture(opened(folder)))) as image:
        apart = np.asarray(first).astype(int) - np.asarray(image)
    assert (np.abs(apart) > 8).mean() < 0.001, "clouds are stored in single precision"


def test_a_search_shows_where_its_first_two_candidates_differ(chair_run: ChairRun, tmp_path: Path) -> None:
    """In one more panel and a cloud, which says of each point whose it is and what the scene says there."""
    some = chair_run.result.object_samples.transformed(chair_run.result.T_scene_object)[::8]
    number = torch.arange(len(some))
    deciding = DecidingSurface(some, number % 2 == 1, (number % 3).to(torch.uint8), True)
    ranking = [
        Candidate("a", "refined", 0.0),
        Candidate("b", "refined", 0.1, difference=Difference(0.1, 0.1, 1.0, True)),
    ]
    said = {"candidates": ranking_document(ranking, {})}
    names = write_artifacts(replace(chair_run.result, deciding=deciding), tmp_path, **said)
    assert set(names) == {*NAMES, "difference.ply"}
    cloud = trimesh.load(tmp_path / "difference.ply")
    np.testing.assert_allclose(cloud.vertices, some.points, atol=1e-5)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert (data["candidate"].ravel() == 1 + number.numpy() % 2).all()
    assert (data["state"].ravel() == number.numpy() % 3).all()
    assert len(np.unique(cloud.colors[:, :3], axis=0)) == 3
    with Image.open(tmp_path / "preview.png") as first, Image.open(BytesIO(stored_picture(opened(tmp_path)))) as image:
        apart = np.asarray(first).astype(int) - np.asarray(image)
        shown = np.asarray(first.convert("RGB")).astype(int)[52:450, 3 * 480 :]
    assert apart.shape[1] == 4 * 480
    assert (np.abs(apart) > 8).mean() < 0.001
    for color in (0, 115, 77), (214, 38, 31), (120, 112, 158):  # of what is not hidden
        assert (np.abs(shown - color).max(-1) < 6).sum() > 100


@pytest.mark.parametrize(
    ("states", "apart", "said"),
    [
        ([0, 1, 1, 2], True, "67 % of the observed difference supports the first."),
        ([0, 1, 1, 2], False, "Too little of the difference was observed to distinguish the two."),
    ],
)
def test_a_part_that_is_there_speaks_for_its_owner_else_for_the_other(
    states: list[int], apart: bool, said: str
) -> None:
    whose = np.array([False, True, False, True])
    assert Deciding(np.zeros((4, 3)), whose, np.array(states, np.uint8), apart).conclusion() == said


def test_of_a_detection_in_an_image_too(chair_run: ChairRun, tmp_path: Path) -> None:
    matrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -4.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    write_artifacts(replace(chair_run.result, camera=CameraView("0", Sim3.from_matrix(matrix))), tmp_path)
    with Image.open(tmp_path / "preview.png") as first, Image.open(BytesIO(stored_picture(opened(tmp_path)))) as image:
        apart = np.asarray(first).astype(int) - np.asarray(image)
    assert (np.abs(apart) > 8).mean() < 0.001


def test_files_that_are_damaged_are_refused(folder: Path, tmp_path: Path) -> None:
    for name in NAMES:
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    cloud = (tmp_path / "scene_points.ply").read_bytes()
    (tmp_path / "scene_points.ply").write_bytes(cloud[:-5])
    with pytest.raises(ValueError, match="multiple"):
        stored_picture(opened(tmp_path))


def opened(folder: Path) -> Callable[[str], BinaryIO]:
    return lambda name: (folder / name).open("rb")


def test_pixels_of_half_the_size_are_means_of_four() -> None:
    points = np.array([[0.2, 0.1, 0.0], [-0.3, -0.2, 0.4]])
    normals, colors = np.array([[0.0, 0.0, 1.0]] * 2), np.array([[0.9, 0.2, 0.1], [0.1, 0.4, 0.8]])
    cloud, view, background = Surfels(points, normals, colors), View(np.eye(3), np.zeros(3), 20.0), np.ones(3)
    nearest = nearest_surfels(cloud, view, 32, 0.3)
    whole = paint(cloud, nearest, view, background).astype(float).reshape(16, 2, 16, 2, 3).mean((1, 3))
    assert len(np.unique(whole)) > 9
    np.testing.assert_allclose(paint_half(cloud, nearest, view, background), whole, atol=0.5)


def test_every_pixel_shows_the_disc_nearest_to_the_viewer() -> None:
    generator = np.random.default_rng(3)
    points, normals = generator.uniform(-1.3, 1.3, (40, 3)), generator.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    size, pixels_per_unit, radius = 48, 20.0, 0.35
    cloud = Surfels(points, normals, np.zeros((40, 3)))
    nearest = nearest_surfels(cloud, View(np.eye(3), np.zeros(3), pixels_per_unit), size, radius)
    middle = (np.arange(size) + 0.5 - size / 2) / pixels_per_unit
    expected = np.full((size, size), -1)
    for i, j in np.ndindex(size, size):
        x, y = middle[j], -middle[i]
        lean = normals[:, :2] * np.sign(normals[:, 2:]) / np.maximum(np.abs(normals[:, 2:]), 0.12)
        away = np.stack([x - points[:, 0], y - points[:, 1]], axis=1)
        height = -(lean * away).sum(1)
        covered = (away**2).sum(1) + height**2 <= radius**2
        if covered.any():
            expected[i, j] = np.where(covered, points[:, 2] + height, -np.inf).argmax()
    assert (nearest == expected).mean() > 0.998  # a disc's very edge falls to either side
    assert (expected >= 0).mean() > 0.3


def test_a_disc_seen_from_the_side_is_narrow() -> None:
    tilted = Surfels(np.zeros((1, 3)), np.array([[np.sqrt(0.75), 0.0, 0.5]]), np.array([[0.0, 0, 0]]))
    picture = render(tilted, View(np.eye(3), np.zeros(3), 20.0), 101, 1.0, np.ones(3))
    drawn = picture.sum(-1) < 3.0
    # Radius 20 pixels, tilted by 60 degrees about the vertical: half as wide as it is high.
    assert drawn.any(1).sum() == pytest.approx(40, abs=2)
    assert drawn.any(0).sum() == pytest.approx(20, abs=2)


def test_a_picture_drawn_in_parts_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = Surfels(rng.normal(size=(400, 3)), normals, np.ones((400, 3)))
    view = View(np.eye(3), np.zeros(3), 15.0)
    whole = nearest_surfels(cloud, view, 96, 0.4)
    for most in (1, 97, 10_000):
        monkeypatch.setattr("regnf_core.viewing.splats._PIXELS_AT_ONCE", most)
        assert np.array_equal(nearest_surfels(cloud, view, 96, 0.4), whole)
    assert (whole >= 0).sum() > 1000


@pytest.mark.parametrize(("count", "radius", "size"), [(4000, 3.0, 160), (300, 12.5, 90), (5, 40.0, 64)])
def test_compiled_code_finds_the_same_discs(
    count: int, radius: float, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of discs beyond the picture, and seen from the side."""
    rng = np.random.default_rng(count)
    normals = rng.normal(size=(count, 3))
    surfels = Surfels(rng.normal(size=(count, 3)), normals / np.linalg.norm(normals, axis=1)[:, None], normals)
    view = View(np.eye(3), np.zeros(3), size / 4)
    for variant in variants():
        monkeypatch.setattr("regnf_core.viewing.splats.variant", lambda variant=variant: variant)
        found = nearest_surfels(surfels, view, size, radius * 4 / size)
        monkeypatch.setattr("regnf_core.viewing.splats.variant", lambda: None)
        expected = nearest_surfels(surfels, view, size, radius * 4 / size)
        assert (expected >= 0).any()
        assert (found != expected).mean() < 1e-3  # where two discs are as near, rounding decides
