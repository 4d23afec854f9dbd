"""The preset as a whole, on exact fields: any scale, any orientation, and an honest verdict."""

from __future__ import annotations

import math

import pytest
import torch

from regnf_core.document import ProgressCallback, RegistrationResult
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register, with_late_clouds
from regnf_core.options import RegistrationOptions
from regnf_core.robust import pipeline
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from tests.core.analytic import AnalyticField, chair, chair_pose, room, table
from tests.core.robust.shapes import (
    ONE_SEARCH,
    ROBUST,
    alone,
    can,
    can_room,
    detection,
    placement_error,
    pose_distance,
    random_pose,
    reframed,
    run,
    slab_table,
    table_room,
)


@pytest.fixture(scope="module")
def reports() -> list[tuple[str, float]]:
    return []


@pytest.fixture(scope="module")
def found(reports: list[tuple[str, float]]) -> RegistrationResult:
    """The room's chair, with clouds."""
    progress: ProgressCallback = lambda phase, done: reports.append((phase, done))  # noqa: E731
    return register(room(chair_pose()), chair(), detection(), ROBUST, progress=progress)


@pytest.fixture(scope="module")
def wrong() -> RegistrationResult:
    """A table in its place."""
    return alone(table, ONE_SEARCH).result


OVER = Sim3.from_quaternion(1.0, [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("scene_pose", "object_pose"),
    [(random_pose(1, 1.0), random_pose(2, 10.0 / float(chair_pose().scale))), (OVER, Sim3.identity())],
    ids=["ten times", "upside down"],
)
def test_any_scale_and_orientation(scene_pose: Sim3, object_pose: Sim3) -> None:
    scene, obj, box, truth = reframed(scene_pose, object_pose)
    result = run(scene, obj, box)
    assert result.verdict == "registered"
    assert placement_error(result, truth) < 0.005
    assert result.metrics["field_evaluations"] <= 150_000
    assert result.metrics["surface_offset"] == 0.0, "a smooth scene has none"


def test_the_same_seed_gives_the_same_numbers_and_clouds_cost_little(found: RegistrationResult) -> None:
    plain = alone().result
    assert torch.equal(plain.T_object_scene.matrix(), found.T_object_scene.matrix())
    assert plain.surroundings is None
    assert plain.residuals == {}
    assert "field_evaluations_clouds" not in plain.metrics
    assert found.metrics["field_evaluations_clouds"] <= 41_000
    assert len(found.scene_samples.points) > 3000
    assert len(found.object_samples.points) > 3000
    off_surface = chair().signed_distance(found.object_samples.points).abs().max()
    assert off_surface < 0.005 * found.metrics["object_diameter"]


def test_the_report_is_whole(found: RegistrationResult, reports: list[tuple[str, float]]) -> None:
    assert placement_error(found, chair_pose()) < 0.005
    assert [done for _, done in reports] == sorted(done for _, done in reports)
    assert len(found.trace) == found.metrics["iterations"] > 5
    last = found.trace[-1].T_object_scene.matrix()
    torch.testing.assert_close(last, found.T_object_scene.matrix(), rtol=0, atol=1e-12)
    assert found.covariance is not None
    assert found.covariance.shape == (7, 7)
    assert (torch.linalg.eigvalsh(found.covariance) > 0).all()


def test_clouds_keep_the_lowest_points_along_z_where_y_points_up() -> None:
    # The y-up scene's lowest points along z are a side of the chair, not the ground.
    quarter = Sim3.from_quaternion(1.0, [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [0.0, 0.0, 0.0])
    scene, obj, box, _ = reframed(quarter, Sim3.identity())
    corners = box.corners()[:, 2]
    side = float(corners.min() + 0.025 * (corners.max() - corners.min()))
    plain = register(scene, obj, box, ROBUST, clouds=False)
    shown = with_late_clouds(plain, scene, obj, box, ROBUST)

    def on_the_side(result: RegistrationResult) -> int:
        return int((result.scene_samples.points[:, 2] < side).sum())

    assert len(shown.scene_samples.points) > len(plain.scene_samples.points)
    assert on_the_side(shown) > on_the_side(plain) > 0


def test_a_table_has_two_poses_and_both_are_told() -> None:
    foot = torch.tensor([[0.0, 0.0, -0.3]], dtype=torch.float64)
    turned = Sim3.from_quaternion(1.4, [0.0, 0.0, math.sin(0.4), math.cos(0.4)], [0.0, 0.0, 0.0])
    truth = Sim3(turned.scale, turned.rotation, foot[0] - turned.apply(torch.tensor([[0.1, 0.0, 0.0]]).double())[0])
    corners = torch.cartesian_prod(*[torch.tensor(v).double() for v in ([-0.45, 0.45], [-0.3, 0.3], [-0.3, 0.16])])
    seen = truth.inverse().apply(corners)
    box = OrientedBox.from_corners(seen.amin(0).tolist(), seen.amax(0).tolist())
    result = run(table_room(truth), slab_table(), box)
    twin = Sim3.from_quaternion(1.0, [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0]) @ truth
    poses = [result.T_object_scene, *(a.T_object_scene for a in result.alternatives)]
    assert result.verdict == "ambiguous"
    assert result.verdict_reason == "SEVERAL_POSES_AGREE"
    assert min(pose_distance(T, truth, result) for T in poses) < 0.01
    assert min(pose_distance(T, twin, result) for T in poses) < 0.01
    assert "180 degrees about z" in [a.relation for a in result.alternatives]


def test_a_wrong_object_is_rejected(wrong: RegistrationResult) -> None:
    assert wrong.verdict == "rejected"
    assert wrong.verdict_reason in {"FREE_SPACE_VIOLATED", "LOW_OVERLAP", "SCENE_UNEXPLAINED", "TOO_LITTLE_SURFACE"}
    assert wrong.alternatives == []


@pytest.mark.parametrize("which", ["found", "wrong"])
def test_the_poses_that_were_judged_are_told_with_what_speaks_against_them(
    which: str, request: pytest.FixtureRequest
) -> None:
    result: RegistrationResult = request.getfixturevalue(which)
    seen = result.considered
    assert seen is not None
    first = seen.poses[0]
    assert (first.reason == "SURFACES_AGREE") == (result.verdict == "registered")
    assert len(seen.poses) == len(seen.scene_signs) == len(seen.object_signs) <= 6
    assert seen.object_signs.shape[1] == len(seen.object_points)
    for pose, of_object, of_scene in zip(seen.poses, seen.object_signs, seen.scene_signs, strict=True):
        shares = {
            "occluded_share_object": (of_object == 2).float().mean(),
            "free_space_violations": (of_object == 1).sum() / (of_object != 2).sum(),
            "explained_share_scene": (of_scene == 0).float().mean(),
        }
        for name, share in shares.items():
            assert float(share) == pytest.approx(pose.metrics[name], abs=1e-6), name
    assert torch.equal(first.T_object_scene.matrix(), result.T_object_scene.matrix())


def test_the_number_of_threads_does_not_change_the_answer(found: RegistrationResult) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3 - min(before, 2))
        other = register(room(chair_pose()), chair(), detection(), ROBUST, clouds=False)
    finally:
        torch.set_num_threads(before)
    assert found.verdict == other.verdict
    assert pose_distance(found.T_object_scene, other.T_object_scene, found) < 1e-4


def test_a_can_has_a_free_axis_and_it_is_told() -> None:
    result = run(can_room(), can(), OrientedBox.from_corners([-0.2, -0.2, 0.0], [0.2, 0.2, 0.5]))
    assert result.verdict == "ambiguous"
    free = [a.relation for a in result.alternatives if "as any turn about this axis" in a.relation]
    assert len(free) >= 4
    assert all("about z" in relation for relation in free)


def test_a_wrong_start_does_no_harm_where_only_turns_about_the_up_axis_are_searched() -> None:
    far = perturbed(chair_pose(), torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]))
    up = RegistrationOptions.from_dict({"up_axis": "z", "robust": {"rotations": 240}})
    result = register(room(chair_pose()), chair(), detection(), up, initial_transform=far, clouds=False)
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose()) < 0.005


def test_a_given_pose_is_refined_whatever_the_search_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = PoseCandidates.start(Sim3.cat([random_pose(seed, 1.0) for seed in range(3)]))
    monkeypatch.setattr(pipeline, "search_poses", lambda *_: wrong)
    assert run(room(chair_pose()), chair(), detection(), ONE_SEARCH).verdict == "rejected"
    start = perturbed(chair_pose(), torch.tensor([0.02, -0.02, 0.03, 0.01, 0.01, -0.01, 0.02]))
    result = register(room(chair_pose()), chair(), detection(), ROBUST, initial_transform=start, clouds=False)
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose()) < 0.005


def perturbed(T: Sim3, step: torch.Tensor) -> Sim3:
    moved = T[None].perturb(step[None].double())
    return Sim3(moved.scale[0], moved.rotation[0], moved.translation[0])


def test_other_seeds_meet_the_same_optimum_at_the_same_place() -> None:
    """In a scene whose errors differ from place to place, so that other samples would have another optimum."""
    exact = room(chair_pose())
    bounds = exact.bounds.tolist()
    rough = AnalyticField(lambda points: exact.formula(points) + 0.008 * torch.sin(17.0 * points).prod(-1), bounds)
    results = [register(rough, chair(), detection(), ROBUST, seed=seed, clouds=False) for seed in range(3)]
    assert [result.verdict for result in results] == ["registered"] * 3
    first, *others = (result.T_object_scene.matrix() for result in results)
    assert float((first - torch.eye(4)).abs().max()) > 0.1
    for other in others:
        torch.testing.assert_close(other, first, atol=5e-5, rtol=0.0)
