"""The preset as a whole, on exact fields: any scale, any orientation, and an honest verdict."""

from __future__ import annotations

import math

import pytest
import torch

from regnf_core.document import RegistrationResult
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import WarmStart, register
from regnf_core.options import RegistrationOptions
from regnf_core.robust import pipeline
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from tests.core.analytic import AnalyticField, chair, chair_pose, room, table
from tests.core.robust.shapes import (
    ROBUST,
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


@pytest.mark.parametrize("ratio", [0.1, 10.0])
def test_any_scale_and_orientation(ratio: float) -> None:
    scene, obj, box, truth = reframed(random_pose(1, 1.0), random_pose(2, ratio / float(chair_pose().scale)))
    result = run(scene, obj, box)
    assert float(truth.scale) == pytest.approx(ratio)
    assert result.verdict == "registered"
    assert placement_error(result, truth) < 0.005
    assert result.metrics["field_evaluations"] <= 150_000


def test_clouds_are_dense_cheap_and_left_out_when_nobody_asks() -> None:
    scene, obj = room(chair_pose()), chair()
    plain = register(scene, obj, detection(), ROBUST, clouds=False)
    shown = register(scene, obj, detection(), ROBUST)
    torch.testing.assert_close(plain.T_object_scene.matrix(), shown.T_object_scene.matrix(), rtol=0, atol=0)
    assert plain.surroundings is None
    assert plain.residuals == {}
    assert "field_evaluations_clouds" not in plain.metrics
    assert shown.metrics["field_evaluations_clouds"] <= 41_000
    assert len(shown.scene_samples.points) > 3000
    assert len(shown.object_samples.points) > 3000
    off_surface = obj.signed_distance(shown.object_samples.points).abs().max()
    assert off_surface < 0.005 * shown.metrics["object_diameter"]


def test_clouds_keep_the_lowest_points_along_z_where_y_points_up() -> None:
    # The y-up scene's lowest points along z are a side of the chair, not the ground.
    quarter = Sim3.from_quaternion(1.0, [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], [0.0, 0.0, 0.0])
    scene, obj, box, _ = reframed(quarter, Sim3.identity())
    corners = box.corners()[:, 2]
    side = float(corners.min() + 0.025 * (corners.max() - corners.min()))
    plain, shown = (register(scene, obj, box, ROBUST, clouds=clouds) for clouds in (False, True))

    def on_the_side(result: RegistrationResult) -> int:
        return int((result.scene_samples.points[:, 2] < side).sum())

    assert len(shown.scene_samples.points) > len(plain.scene_samples.points)
    assert on_the_side(shown) > on_the_side(plain) > 0


def test_upside_down() -> None:
    over = Sim3.from_quaternion(1.0, [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    scene, obj, box, truth = reframed(over, Sim3.identity())
    result = run(scene, obj, box)
    assert result.verdict == "registered"
    assert placement_error(result, truth) < 0.005


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


def test_a_wrong_object_is_rejected() -> None:
    result = run(room(chair_pose()), table(), detection())
    assert result.verdict == "rejected"
    assert result.verdict_reason in {"FREE_SPACE_VIOLATED", "LOW_OVERLAP", "SCENE_UNEXPLAINED", "TOO_LITTLE_SURFACE"}
    assert result.alternatives == []


def test_the_poses_that_were_judged_are_told_with_what_speaks_against_them() -> None:
    """The signs are those that the metrics count."""
    scene, obj = room(chair_pose()), chair()
    for result in (run(scene, obj, detection()), run(scene, table(), detection())):
        seen = result.considered
        assert seen is not None
        first = seen.poses[0]
        assert (first.reason == "SURFACES_AGREE") == (result.verdict == "registered")
        assert len(seen.poses) == len(seen.scene_signs) == len(seen.object_signs) <= 6
        assert seen.object_signs.shape[1] == len(seen.object_points)
        for pose, of_object, of_scene in zip(seen.poses, seen.object_signs, seen.scene_signs, strict=True):
            unseen, free = (of_object == 2).float().mean(), (of_object == 1).float()
            assert float(unseen) == pytest.approx(pose.metrics["occluded_share_object"], abs=1e-6)
            assert float(free.sum() / (of_object != 2).sum()) == pytest.approx(
                pose.metrics["free_space_violations"], abs=1e-6
            )
            explained = (of_scene == 0).float().mean()
            assert float(explained) == pytest.approx(pose.metrics["explained_share_scene"], abs=1e-6)
        torch.testing.assert_close(first.T_object_scene.matrix(), result.T_object_scene.matrix(), rtol=0, atol=0)


def test_the_same_seed_gives_the_same_numbers_and_the_report_is_whole() -> None:
    scene, obj = room(chair_pose()), chair()
    reports: list[tuple[str, float]] = []
    first = register(
        scene, obj, detection(), ROBUST, seed=4, progress=lambda phase, done: reports.append((phase, done))
    )
    second = run(scene, obj, detection(), seed=4)
    torch.testing.assert_close(first.T_object_scene.matrix(), second.T_object_scene.matrix(), rtol=0, atol=0)
    assert placement_error(first, chair_pose()) < 0.005
    assert [done for _, done in reports] == sorted(done for _, done in reports)
    assert len(first.trace) == first.metrics["iterations"] > 5
    torch.testing.assert_close(
        first.trace[-1].T_object_scene.matrix(), first.T_object_scene.matrix(), rtol=0, atol=1e-12
    )
    assert first.covariance is not None
    assert first.covariance.shape == (7, 7)
    assert (torch.linalg.eigvalsh(first.covariance) > 0).all()


def test_the_number_of_threads_does_not_change_the_answer() -> None:
    scene, obj = room(chair_pose()), chair()
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(run(scene, obj, detection(), seed=5))
    finally:
        torch.set_num_threads(before)
    one, two = results
    assert one.verdict == two.verdict
    assert pose_distance(one.T_object_scene, two.T_object_scene, one) < 1e-4


def test_a_can_has_a_free_axis_and_it_is_told() -> None:
    result = run(can_room(), can(), OrientedBox.from_corners([-0.2, -0.2, 0.0], [0.2, 0.2, 0.5]))
    assert result.verdict == "ambiguous"
    free = [a.relation for a in result.alternatives if "as any turn about this axis" in a.relation]
    assert len(free) >= 4
    assert all("about z" in relation for relation in free)


def test_a_warm_start_is_refined_and_a_wrong_one_does_no_harm() -> None:
    near = perturbed(chair_pose(), torch.tensor([0.1, -0.1, 0.15, 0.02, 0.02, -0.02, 0.05]))
    far = perturbed(chair_pose(), torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]))
    for start in (near, far):
        result = register(room(chair_pose()), chair(), detection(), ROBUST, warm_start=WarmStart(T_object_scene=start))
        assert result.verdict == "registered"
        assert placement_error(result, chair_pose()) < 0.005


def test_a_given_pose_is_refined_whatever_the_search_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = PoseCandidates.start(Sim3.cat([random_pose(seed, 1.0) for seed in range(3)]))
    monkeypatch.setattr(pipeline, "search_poses", lambda *_: wrong)
    assert run(room(chair_pose()), chair(), detection()).verdict == "rejected"
    start = perturbed(chair_pose(), torch.tensor([0.02, -0.02, 0.03, 0.01, 0.01, -0.01, 0.02]))
    result = register(room(chair_pose()), chair(), detection(), ROBUST, warm_start=WarmStart(T_object_scene=start))
    assert result.verdict == "registered"
    assert placement_error(result, chair_pose()) < 0.005


def test_with_an_up_axis_only_turns_about_it_are_searched() -> None:
    up = RegistrationOptions.from_dict({"up_axis": "z", "robust": {"rotations": 240}})
    result = run(room(chair_pose()), chair(), detection(), up)
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
    results = [register(rough, chair(), detection(), ROBUST, seed=seed, clouds=False) for seed in range(8)]
    assert [result.verdict for result in results] == ["registered"] * 8
    first, *others = (result.T_object_scene.matrix() for result in results)
    assert float((first - torch.eye(4)).abs().max()) > 0.1
    for other in others:
        torch.testing.assert_close(other, first, atol=5e-5, rtol=0.0)
