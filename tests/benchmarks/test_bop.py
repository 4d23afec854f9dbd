"""BOP's errors against values by hand and by brute force, and the command on a folder that is rendered here."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.bop.__main__ import main
from benchmarks.bop.answers import Answer, judged, read_csv, recall, write_csv
from benchmarks.bop.dataset import Dataset, Detections, Target
from benchmarks.bop.errors import MSSD_LIMITS, matched, mspd, mssd, outermost, surfaces_apart, symmetries_of
from benchmarks.bop.writing import Picture, Placed, placed, rendered, write_scene
from benchmarks.worlds.mesh_scene import MeshScene, box_thing, load_thing, tile_paint
from benchmarks.worlds.rendering import render

Array = NDArray[np.float64]

K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
_AT_HALVES = K + np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
WIDTH = 320
_POINTS = np.array([[0, 0, 0], [120, 0, 0], [110, 60, 0], [0, 80, 0], [10, 10, 70], [60, 10, 50], [10, 50, 40.0]])


def pose(vector: tuple[float, float, float], place: tuple[float, float, float]) -> Array:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    out[:3, 3] = place
    return out


def wedge() -> trimesh.Trimesh:
    """A body without symmetries, 0.13 m, in mm."""
    return trimesh.convex.convex_hull(_POINTS)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images of the wedge on a table; in the second one it stands half behind a box."""
    folder = tmp_path_factory.mktemp("bop") / "tiny"
    (folder / "models").mkdir(parents=True)
    mesh = wedge()
    mesh.export(folder / "models" / "obj_000003.ply")
    diameter = float(np.linalg.norm(_POINTS[:, None] - _POINTS[None], axis=2).max())
    (folder / "models" / "models_info.json").write_text(json.dumps({"3": {"diameter": diameter}}))
    truth = pose((2.2, 0.5, 0.2), (-40.0, 10.0, 600.0))
    scaled = truth.copy()
    scaled[:3, 3] /= 1000.0
    scaled[:3, :3] /= 1000.0
    thing = load_thing(folder / "models" / "obj_000003.ply", scaled, "wedge")
    tiles = tile_paint((0.9, 0.9, 0.9), (0.5, 0.5, 0.5), 0.05)
    table = box_thing((-1.0, -1.0, 0.66), (1.0, 1.0, 0.7), tiles)
    screen = box_thing((-0.3, -0.2, 0.4), (0.0, 0.2, 0.41), tiles)
    pictures: dict[int, tuple[Picture, list[Placed]]] = {}
    for im_id, things in ((7, [table, thing]), (12, [table, thing, screen])):
        view = render(MeshScene(things), (240, WIDTH), _AT_HALVES, np.eye(4))
        alone = render(MeshScene([thing]), (240, WIDTH), _AT_HALVES, np.eye(4))
        shown = Placed(3, truth, view.thing == 1, alone.thing == 0)
        pictures[im_id] = (Picture(1000.0 * view.depth, K, view.colors), [shown])
    write_scene(folder / "test" / "000001", pictures)
    return folder


# The errors.


def test_mssd_and_mspd_of_a_known_shift() -> None:
    vertices, identity = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 5.0]]), np.eye(4)[None]
    true, moved = pose((0, 0, 0), (0, 0, 500)), pose((0, 0, 0), (3, 4, 500))
    assert mssd(moved, true, vertices, identity) == pytest.approx(5.0)
    # The nearest vertex, at 500 mm, moves most in the image: 300 pixels times 5 mm by 500 mm.
    assert mspd(moved, true, vertices, identity, K) == pytest.approx(3.0)
    behind = pose((0, 0, 0), (0, 0, -500))
    assert mspd(behind, true, vertices, identity, K) > 1e6


def test_a_turn_about_the_axis_of_a_cylinder_is_no_error() -> None:
    vertices = trimesh.creation.cylinder(30.0, 100.0, sections=90).vertices + np.array([5.0, 0.0, 0.0])
    diameter = 2.0 * math.hypot(30.0, 50.0)
    info = {"diameter": diameter, "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [5, 0, 0]}]}
    symmetries = symmetries_of(info, vertices)
    # The farthest vertex moves by 1 % of the diameter at most.
    assert len(symmetries) == math.ceil(2.0 * math.pi * 30.0 / (0.01 * diameter))
    true = pose((0.3, 0.2, 0.1), (10, 20, 700))
    for angle in (0.3, 2.0, 5.0):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
        turn[:3, 3] = [5 - 5 * math.cos(angle), -5 * math.sin(angle), 0]
        assert mssd(true @ turn, true, outermost(vertices), symmetries) <= 0.005 * diameter
        assert mspd(true @ turn, true, vertices, symmetries, K) < 1.0
        assert mssd(true @ turn, true, vertices, symmetries[:1]) > 0.005 * diameter
    tilted = true @ pose((0.2, 0, 0), (0, 0, 0))
    assert mssd(tilted, true, vertices, symmetries) == pytest.approx(
        _by_brute_force(tilted, true, vertices, symmetries)
    )


@pytest.mark.parametrize("seed", range(4))
def test_mssd_is_that_of_all_vertices_and_symmetries(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(60, 3)) * [20, 30, 50]
    flips = [np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist(), np.diag([1.0, -1.0, -1.0, 1.0]).ravel().tolist()]
    continuous = [{"axis": rng.normal(size=3).tolist(), "offset": rng.normal(size=3).tolist()}] if seed % 2 else []
    info = {"diameter": 200.0, "symmetries_discrete": flips, "symmetries_continuous": continuous}
    symmetries = symmetries_of(info, vertices)
    assert np.allclose(symmetries[0], np.eye(4))
    first, second = (pose(tuple(rng.normal(size=3)), tuple(rng.normal(size=3) * 20 + [0, 0, 500])) for _ in range(2))
    expected = _by_brute_force(first, second, vertices, symmetries)
    assert mssd(first, second, outermost(vertices), symmetries) == pytest.approx(expected)


def _by_brute_force(first: Array, second: Array, vertices: Array, symmetries: Array) -> float:
    points = np.column_stack([vertices, np.ones(len(vertices))])
    return min(
        max(np.linalg.norm((points @ first.T - points @ (second @ symmetry).T)[:, :3], axis=1))
        for symmetry in symmetries
    )


def test_surfaces_of_a_turned_cube_are_not_apart() -> None:
    cube = trimesh.creation.box((40.0, 40.0, 40.0))
    mesh, true = (np.asarray(cube.vertices), np.asarray(cube.faces)), pose((0.1, 0.2, 0.3), (0, 0, 500))
    assert surfaces_apart(true @ pose((0, 0, math.pi / 2), (0, 0, 0)), true, mesh) == pytest.approx(0.0, abs=1e-3)
    assert surfaces_apart(true @ pose((0, 0, 0), (0, 3, 0)), true, mesh) == pytest.approx(3.0, abs=1e-3)


@pytest.mark.parametrize(
    ("errors", "scores", "limit", "expected"),
    [
        ([[1.0, 5.0]], [0.5], 2.0, [True, False]),
        ([[1.0, 5.0]], [0.5], 1.0, [False, False]),  # right is below the limit
        ([[1.0, 1.5], [1.2, 9.0]], [0.9, 0.1], 2.0, [True, False]),  # the first takes what the second needs
        ([[1.0, 1.5], [1.2, 9.0]], [0.1, 0.9], 2.0, [True, True]),
    ],
)
def test_estimates_take_the_nearest_truths_by_score(
    errors: list[list[float]], scores: list[float], limit: float, expected: list[bool]
) -> None:
    assert matched(np.array(errors), scores, limit).tolist() == expected


# The folder.


def test_a_rendered_scene_says_what_is_visible(dataset: Path) -> None:
    found = Dataset.of(dataset)
    assert found.targets == (Target(1, 7, 3, 1), Target(1, 12, 3, 1))
    (whole,), (hidden,) = found.truths(1, 7), found.truths(1, 12)
    assert whole.visible == 1.0
    assert 0.2 < hidden.visible < 0.8
    mask = found.mask(1, 12, 0)
    assert mask is not None
    assert hidden.box is not None
    rows, columns = np.nonzero(mask)
    assert hidden.box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    # Two renderers agree on what is seen of the thing at its true pose.
    with_depth = found.picture(1, 12)
    (again,) = placed(with_depth, [found.judged(3).mesh], [3], [hidden.pose])
    assert (again.visible & mask).sum() > 0.97 * (again.visible | mask).sum()
    assert np.abs(rendered(found.judged(3).mesh, whole.pose, with_depth) - found.picture(1, 7).depth)[mask].max() < 0.2


def test_recall_counts_targets_without_an_answer(dataset: Path) -> None:
    found = Dataset.of(dataset)
    truth = found.truths(1, 7)[0].pose
    off = truth.copy()
    off[0, 3] += 0.12 * found.judged(3).diameter
    answers = [judged(found, Answer(1, 7, 3, "registered", "", 0.9, tuple(off.ravel().tolist())))]
    assert answers[0].mssd == pytest.approx(0.12)
    assert not answers[0].right
    # Right at the eight limits from 0.15 on, for one of two targets.
    assert recall(found, found.targets, answers, WIDTH).mssd == pytest.approx(0.5 * (MSSD_LIMITS > 0.12).mean())
    assert recall(found, found.targets, [], WIDTH).mspd == 0.0


def test_poses_survive_the_file(tmp_path: Path) -> None:
    answers = [
        Answer(1, 2, 3, "registered", "", 0.5, tuple(pose((0.1, 2, 3), (4, 5, 6)).ravel().tolist()), seconds=2.0)
    ]
    write_csv(tmp_path / "x.csv", [*answers, Answer(1, 2, 4, "failed", seconds=1.0)])
    (row,) = csv.DictReader((tmp_path / "x.csv").read_text().splitlines())
    assert row["time"] == "3.000"
    assert len(row["R"].split()) == 9
    (back,) = read_csv(tmp_path / "x.csv")
    assert back.matrix is not None
    assert answers[0].matrix is not None
    assert np.allclose(back.matrix, answers[0].matrix, atol=1e-6)


def test_detections_of_a_detector(dataset: Path, tmp_path: Path) -> None:
    common = {"scene_id": 1, "image_id": 7, "category_id": 3, "bbox": [10, 20, 30, 40]}
    rows = [
        common | {"score": 0.2},
        common | {"score": 0.9, "bbox": [1, 2, 3, 4]},
        common | {"category_id": 5, "score": 1},
    ]
    (tmp_path / "found.json").write_text(json.dumps(rows))
    found = Dataset.of(dataset)
    ((detection, truth),) = Detections.read(tmp_path / "found.json").of(found, found.targets[0])
    assert detection.box_2d == (1.0, 2.0, 4.0, 6.0)
    assert detection.score == 0.9
    assert truth is None
    ((boxed, _),) = Detections(boxes=True).of(found, found.targets[0])
    assert boxed.mask is None
    assert boxed.box_2d == found.truths(1, 7)[0].box


def test_the_command_registers_and_judges(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = Dataset.of(dataset).truths(1, 7)[0].pose
    theirs = Answer(1, 7, 3, "registered", "", 1.0, tuple(truth.ravel().tolist()))
    write_csv(tmp_path / "exact_tiny-test.csv", [theirs])
    arguments = [str(dataset), "--output", str(tmp_path / "out"), "--limit", "1", "--width", str(WIDTH)]
    assert main([*arguments, "--results", str(tmp_path / "exact_tiny-test.csv")]) == 0
    (answer,) = (json.loads(line) for line in (tmp_path / "out" / "regnf.jsonl").read_text().splitlines())
    assert answer["verdict"] == "registered", answer
    assert answer["mssd"] < 0.05
    (pose_given,) = read_csv(tmp_path / "out" / "regnf_tiny-test.csv")
    assert pose_given.probability == pytest.approx(answer["probability"], abs=1e-5)
    text = (tmp_path / "out" / "table.md").read_text()
    assert "## exact" in text
    assert "AR of MSSD 1.000" in text
    assert text.strip() == capsys.readouterr().out.strip()


def test_a_folder_without_models_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "test").mkdir()
    assert main([str(tmp_path), "--output", str(tmp_path / "out")]) == 2
    assert "--models" in capsys.readouterr().err
