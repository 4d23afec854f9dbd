"""Worlds as files, their truth, and the tables made of their runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.random_worlds.models import PARTS, read_catalog
from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds import observing
from benchmarks.worlds.cases import cases_of
from benchmarks.worlds.evidence import Gathering, evidence_of_world
from benchmarks.worlds.making import WORLD, Task, make, read_cameras
from benchmarks.worlds.recipe import SCENES, Scene, parts_of_name
from benchmarks.worlds.tables import lost_at, markdown, success, wrong
from regnf_core import Sim3
from regnf_core.errors import DatasetError
from regnf_core.fields.observation import Observation, observation_of
from regnf_core.robust.verdict.evidence import SPEAKS_FOR
from regnf_core.schema.description import FREE, SURFACE


def test_the_truth_puts_every_object_onto_the_scenes_surface(world: Task) -> None:
    made = list(cases_of(world.home))
    assert made
    for one in made:
        truth = one.case.truth
        assert truth is not None
        placed = truth.inverse().apply(one.points)
        off = one.case.scene.signed_distance(placed).abs() * float(truth.scale)
        size = float(torch.pdist(one.points[::20]).max())
        assert float(off.quantile(0.95)) < 1e-3 * size
        assert one.case.detection.contains(placed, 1e-6).all()
        seen = observation_of(one.case.scene)
        assert seen is not None
        assert float((seen.at(placed) == SURFACE).float().mean()) > 0.05
    assert make(world).endswith("there")


def test_what_cameras_saw_is_told_by_where_they_stood_alone(world: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observing, "_EVALUATIONS", 300_000)
    T_scene_room = Sim3.from_matrix(json.loads((world.home / WORLD).read_text())["T_scene_room"])
    camera = T_scene_room.apply(read_cameras(world.home).positions)
    one = next(cases_of(world.home, "cameras"))
    seen = observation_of(one.case.scene)
    assert seen is not None
    assert one.case.truth is not None
    placed = one.case.truth.inverse().apply(one.points)
    found = placed[seen.at(placed) == SURFACE]
    assert len(found) > 100
    places = torch.cat([found + share * (camera - found) for share in (0.15, 0.2)])
    before = seen.at(places[_within(seen, places)])
    assert len(before) > 100
    assert float((before == FREE).float().mean()) > 0.95
    by_map = next(cases_of(world.home, "map"))
    assert observation_of(by_map.case.scene) is None
    assert not by_map.facts["observed"]


def _within(seen: Observation, places: Tensor) -> Tensor:
    """(N,): which places (N, 3) lie in the grid of what was seen; the camera may stand outside of it."""
    assert seen.T_grid_frame is not None
    cells = (seen.T_grid_frame.apply(places) - seen.low) / seen.voxel
    return ((cells >= 0.0) & (cells < torch.tensor(seen.states.shape))).all(-1)


@pytest.mark.long
def test_a_world_of_rendered_images_has_no_drift_and_a_field_of_depths(tmp_path: Path, meshes: Path) -> None:
    task = Task(12, "single", "rendered", (meshes,), tmp_path / "worlds")
    make(task)
    told = json.loads((task.home / WORLD).read_text())
    assert (told["sensor"]["principle"], told["drift"], told["scene"]) == ("rendered", 0.0, {"kind": "rendered"})
    assert told["fusion"]["farthest_m"] == told["sensor"]["farthest_m"], "what counts as measured is in the map"
    for one in cases_of(task.home):
        assert one.case.truth is not None
        assert one.facts["drift_spread"] == 0.0
        placed = one.case.truth.inverse().apply(one.points)
        seen = observation_of(one.case.scene)
        assert seen is not None
        off = one.case.scene.signed_distance(placed[seen.at(placed) == SURFACE]).abs() * float(one.case.truth.scale)
        assert float(off.median()) < 0.01 * float(torch.pdist(one.points[::20]).max())
    by_map, by_nothing = (next(cases_of(task.home, by)) for by in ("map", "nothing"))
    assert [one.facts["observed"] for one in (by_map, by_nothing)] == [True, False], "its weights tell what was seen"
    weighed, bare = by_map.case.scene, by_nothing.case.scene
    assert observation_of(weighed) is not None
    assert observation_of(bare) is None
    assert torch.equal(weighed.signed_distance(placed), bare.signed_distance(placed))


@pytest.mark.parametrize("scene", SCENES)
def test_a_worlds_name_tells_its_scene_seed_and_length(scene: Scene, tmp_path: Path) -> None:
    task = Task(37, "short", scene, (), tmp_path)
    assert parts_of_name(task.home.name) == (scene, 37, "short")


def test_parts_share_no_mesh_and_a_folder_without_meshes_is_named(tmp_path: Path, meshes: Path) -> None:
    catalogs = [read_catalog([meshes], part) for part in PARTS]
    drawn = [{*catalog.small, *catalog.big} for catalog in catalogs]
    assert not (drawn[0] & drawn[1] | drawn[0] & drawn[2] | drawn[1] & drawn[2])
    assert sum(map(len, drawn)) == 12
    with pytest.raises(DatasetError, match="has no meshes"):
        read_catalog([tmp_path / "absent"], "train")


def run(**changes: object) -> dict[str, object]:
    """A success, changed."""
    facts = {"world": "w", "part": "train", "kind": "room", "length": "long", "walk": "long", "scene": "tsdf",
             "sensor": "stereo", "pixels": "160x120", "case": 0, "object": "mug", "field": "mesh", "seen": 0.5,
             "voxels_across": 30.0, "drift_spread": 0.0, "observed": True, "seconds": 1.0}  # fmt: skip
    found = {"verdict": "registered", "reason": "SURFACES_AGREE", "mssd_share": 0.01, "listed_mssd": 0.01,
             "near_mssd": 0.01, "searched_mssd": 0.02, "refined_mssd": 0.01, "truth_mssd": 0.01}  # fmt: skip
    return facts | found | changes


def test_a_run_is_lost_at_the_first_stage_without_a_right_pose() -> None:
    assert lost_at(run()) == "none"
    assert lost_at(run(verdict="rejected")) == "verdict"
    assert lost_at(run(mssd_share=0.3, listed_mssd=0.3)) == "choice"
    assert lost_at(run(mssd_share=0.3, listed_mssd=0.3, refined_mssd=0.3)) == "refinement"
    assert lost_at(run(mssd_share=0.3, listed_mssd=0.3, refined_mssd=0.3, searched_mssd=0.3)) == "search"
    assert success(run(verdict="ambiguous", mssd_share=0.3))
    assert wrong(run(mssd_share=0.3))
    text = markdown([run(), run(verdict="rejected"), run(length="short")])
    assert "| long | 2 | 1/2 (50.0 %) |" in text


def test_the_report_tells_how_many_true_poses_lie_in_their_ellipsoids() -> None:
    """chi2.ppf(.95, 7) = 14.07; wrong poses and objects of revolution have no distance."""
    squares = [2.0, 7.0, 14.0, 14.1, None]
    text = markdown([run(mahalanobis_squared=square) for square in squares] + [run(length="single", mssd_share=0.2)])
    assert "| long | 3/4 (75.0 %) | 2.00 | 2.01 |" in text
    assert "nan" not in text


# Rows of evidence: the right object's, and those of one with a part more, which are all wrong.


@pytest.mark.long
def test_rows_of_the_right_object_and_of_one_with_a_part_more(world: Task) -> None:
    rows = evidence_of_world(world.home, [world.home], Gathering(cases=1, kinds=("right", "part more")))
    altered = [row for row in rows if row["question"] == "part more"]
    right = [row for row in rows if row["question"] == "right"]
    assert min(row["mssd"] for row in right) <= SUCCESS
    assert altered
    assert min(row["mssd"] for row in altered) > SUCCESS
    for kind in (altered, right):
        chosen = [row for row in kind if row["winner"]]
        assert len(chosen) == 1
        assert chosen[0]["verdict"] in ("registered", "ambiguous", "rejected")
        assert set(chosen[0]["features"]) == set(SPEAKS_FOR)
