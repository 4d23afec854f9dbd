"""Whole registrations by the published method: a chair at scale 1.25, wrong objects, seeds, progress, cancelling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from regnf_core.document import Phase
from regnf_core.errors import CancelledError, InitializationError, InvalidInputError, InvalidOptionsError
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.metrics import errors_against_truth
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import model_object, register
from regnf_core.options import OptimizationOptions, RegistrationOptions
from regnf_core.processes import in_processes
from tests.core.analytic import AnalyticField, chair, chair_box, chair_pose, room, sphere
from tests.core.conftest import QUICK, ChairRun

OPTIONS = RegistrationOptions.from_dict(QUICK)
BRIEF = replace(OPTIONS, optimization=OptimizationOptions(iterations=12, samples_per_iteration=200))


def test_the_chair_is_registered(chair_run: ChairRun) -> None:
    result = chair_run.result
    assert (result.verdict, result.verdict_reason) == ("registered", "SURFACES_AGREE")
    errors = errors_against_truth(result.T_object_scene, chair_run.truth, result.object_samples.points)
    assert errors["rotation_error_rad"] < 0.02
    assert errors["center_error_share"] < 0.02
    assert errors["scale_error_share"] < 0.02
    assert errors["mssd_share"] < 0.03


def test_the_result_is_complete(chair_run: ChairRun) -> None:
    result = chair_run.result
    names = {"residual_rms", "inlier_share_scene", "inlier_share_object", "iterations", "field_evaluations"}
    phases = {f"seconds_{phase}" for phase in ("sampling", "initializing", "optimizing", "verifying")}
    assert names | phases <= set(result.metrics)
    assert result.seed == 1
    assert result.options == OPTIONS.to_dict()
    assert float(result.T_object_scene_initial.scale) == pytest.approx(1.0, abs=1e-9)
    assert [record.iteration for record in result.trace] == list(range(len(result.trace)))
    assert len(result.residuals["scene_points"]) == len(result.residuals["scene_residuals"])
    assert len(result.residuals["object_points"]) == len(result.residuals["object_residuals"])


def test_the_trace_keeps_each_iterations_transform(chair_run: ChairRun) -> None:
    trace = chair_run.result.trace
    torch.testing.assert_close(
        trace[0].T_object_scene.matrix(), chair_run.result.T_object_scene_initial.matrix(), rtol=0, atol=1e-9
    )
    scales = torch.stack([record.T_object_scene.scale for record in trace])
    assert float(scales[0]) == pytest.approx(1.0)
    assert float(scales[-1]) == pytest.approx(1.25, rel=0.02)
    assert float((scales[1:] - scales[:-1]).abs().max()) < 0.02  # Adam's steps are about the rate, 0.01


def test_field_evaluations_are_counted_and_progress_never_falls() -> None:
    T = chair_pose()
    scene, obj = CountingField(room(T)), CountingField(chair())
    until: dict[Phase, int] = {}
    seen: list[tuple[Phase, float]] = []

    def progress(phase: Phase, done: float) -> None:
        until.setdefault(phase, scene.evaluations + obj.evaluations)
        seen.append((phase, done))

    result = register(scene, obj, chair_box(T), BRIEF, progress=progress)
    assert result.metrics["field_evaluations"] == until["exporting"] > until["verifying"] > 0
    in_all = scene.evaluations + obj.evaluations
    assert result.metrics["field_evaluations_clouds"] == in_all - until["exporting"] > 0
    phases = ["sampling", "initializing", "optimizing", "verifying", "exporting"]
    assert list(dict.fromkeys(phase for phase, _ in seen)) == phases
    shares = [done for _, done in seen]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert sum(phase == "optimizing" for phase, _ in seen) >= 12


def test_a_progress_callback_may_cancel() -> None:
    T = chair_pose()
    iterations = 0

    def stop(phase: Phase, done: float) -> None:
        nonlocal iterations
        iterations += phase == "optimizing"
        if iterations > 3:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        register(room(T), chair(), chair_box(T), BRIEF, progress=stop)
    assert iterations == 4


@pytest.mark.parametrize(
    ("known", "reason"),
    [
        ({"initial_transform": Sim3.identity()}, "PRESET_UNSUITABLE"),
        ({"object_model": model_object(chair())}, "INVALID_OPTIONS"),
    ],
    ids=["initial transform", "object model"],
)
def test_what_only_robust_takes_is_refused_before_any_work(known: dict[str, Any], reason: str) -> None:
    scene = CountingField(room(chair_pose()))
    with pytest.raises(InvalidOptionsError, match="only the preset `robust`") as raised:
        register(scene, chair(), chair_box(chair_pose()), OPTIONS, **known)
    assert raised.value.reason == reason
    assert scene.evaluations == 0


def test_a_ball_offers_no_features_to_match() -> None:
    T = chair_pose()
    with pytest.raises(InitializationError):
        register(room(T), sphere(0.35), chair_box(T), OPTIONS)


def registered_briefly() -> tuple[str, str]:
    T = chair_pose()
    found = register(room(T), chair(), chair_box(T), BRIEF, seed=7)
    points = found.residuals["scene_points"]
    return found.T_object_scene.matrix().numpy().tobytes().hex(), points.numpy().tobytes().hex()


def test_the_same_seed_gives_the_same_result_in_another_process_too() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        here = registered_briefly()
    finally:
        torch.set_num_threads(threads)
    (there,) = in_processes(lambda _: registered_briefly(), [0], 1)
    assert there == here


def test_it_stops_early_once_the_residuals_are_small_in_an_oriented_box_too() -> None:
    T = chair_pose(scale=1.0)
    back = T.inverse()
    center = back.apply(torch.tensor([[0.03, 0.0, 0.01]], dtype=torch.float64))[0]
    box = OrientedBox(center, torch.tensor([0.56, 0.52, 0.84], dtype=torch.float64), back.rotation)
    options = RegistrationOptions.from_dict({**QUICK, "optimization": {"stop_residual": 0.01}})
    result = register(room(T), chair(), box, options, seed=1, clouds=False)
    assert (result.verdict, result.metrics["converged"]) == ("registered", 1.0)
    last = result.trace[-1]
    assert len(result.trace) < 200
    assert max(last.residual_scene, last.residual_object) <= 0.01
    torch.testing.assert_close(result.T_object_scene.matrix(), last.T_object_scene.matrix())


def test_a_field_that_breaks_down_on_the_way_is_reported() -> None:
    T = chair_pose()
    calls = 0
    scene = room(T)

    def late(points: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        value = scene.formula(points)
        return value * torch.nan if calls > 60 else value

    with pytest.raises(InvalidInputError) as caught:
        register(AnalyticField(late, scene.bounds.tolist()), chair(), chair_box(T), OPTIONS)
    assert caught.value.reason == "FIELD_NOT_FINITE"


@pytest.mark.long
def test_golden_chair_with_published_options() -> None:
    T = chair_pose(0.8)
    result = register(room(T), chair(), chair_box(T), RegistrationOptions(preset="paper"), seed=2, clouds=False)
    errors = errors_against_truth(result.T_object_scene, T, result.object_samples.points)
    assert result.verdict == "registered"
    assert errors["rotation_error_rad"] < 0.03
    assert errors["center_error_share"] < 0.03
    assert errors["scale_error_share"] < 0.02
