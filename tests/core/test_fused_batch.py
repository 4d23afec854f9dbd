"""Many pairs at once give what each gives alone, whichever go together, bit by bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from regnf_core import batch
from regnf_core.batch import BatchOutcome, register_batch
from regnf_core.errors import CancelledError, FieldFormatError
from regnf_core.fields.observation import Observation, ObservedField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import Phase, RegistrationResult
from regnf_core.robust.fused.parts import Sizes, parts_of
from tests.core.analytic import AnalyticField, chair, chair_pose, room, table
from tests.core.robust.shapes import detection, slab_table, table_room

QUICK = {"rotations": 100, "feature_draws": 1, "scene_samples": 900, "object_samples": 500}
ALONE = RegistrationOptions.from_dict({"robust": QUICK})
MEMORY = 16 * 2**20
TOGETHER = RegistrationOptions.from_dict({"robust": {**QUICK, "batch_memory": MEMORY}})
SCENE = room(chair_pose())
NOWHERE = OrientedBox.from_corners([0.2, -0.9, 0.5], [0.5, -0.6, 0.8])
LOOSE = OrientedBox.from_center(detection().center.tolist(), (1.3 * detection().size).tolist())
BOXES = [detection(), LOOSE, NOWHERE]
OBJECTS = [chair(), table()]
PAIRS = [(0, 0), (0, 1), (1, 0), (2, 0), (1, 1)]


def register(
    pairs: Sequence[tuple[int, int]], options: RegistrationOptions = TOGETHER, scene: SdfField = SCENE
) -> list[BatchOutcome]:
    return register_batch(scene, BOXES, OBJECTS, pairs, options, seed=3, clouds=False)


def bits(one: BatchOutcome) -> tuple[object, ...]:
    """All that a result says, but for the seconds."""
    if one.result is None:
        assert one.error is not None
        return one.detection, one.object, one.error.reason
    r = one.result
    assert r.considered is not None
    assert r.covariance is not None
    tensors: list[Tensor] = [r.T_object_scene.matrix(), r.covariance]
    tensors += [step.T_object_scene.matrix() for step in r.trace]
    tensors += [pose.T_object_scene.matrix() for pose in r.considered.poses]
    metrics = {name: value for name, value in r.metrics.items() if not name.startswith("seconds")}
    return one.detection, one.object, r.verdict, [one.numpy().tobytes() for one in tensors], metrics


@pytest.fixture(scope="module")
def together() -> dict[tuple[int, int], BatchOutcome]:
    return {(one.detection, one.object): one for one in register(PAIRS)}


@pytest.mark.slow
@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(PAIRS), min_size=1, max_size=4))
def test_a_result_depends_neither_on_the_other_pairs_nor_on_their_order(
    together: dict[tuple[int, int], BatchOutcome], some: list[tuple[int, int]]
) -> None:
    for found, pair in zip(register(some), some, strict=True):
        assert bits(found) == bits(together[pair])


def test_each_pair_ends_as_it_would_alone(together: dict[tuple[int, int], BatchOutcome]) -> None:
    for alone in register(PAIRS, ALONE):
        assert_same_but_for_rounding(together[alone.detection, alone.object], alone, BOXES[alone.detection])


def assert_same_but_for_rounding(found: BatchOutcome, alone: BatchOutcome, box: OrientedBox) -> None:
    if alone.result is None or found.result is None:
        assert alone.error is not None
        assert found.error is not None
        assert found.error.reason == alone.error.reason
        return
    assert found.result.verdict == alone.result.verdict
    assert found.result.verdict_reason == alone.result.verdict_reason
    assert apart(found.result, alone.result, box) < 1e-4
    for name in ("field_evaluations", "iterations", "pose_candidates"):
        assert found.result.metrics[name] == alone.result.metrics[name]
    assert found.result.seed == alone.result.seed


def apart(one: RegistrationResult, other: RegistrationResult, box: OrientedBox) -> float:
    """Largest distance between the places of the box's corners, object diameters."""
    corners = box.corners()
    moved = one.T_object_scene.apply(corners) - other.T_object_scene.apply(corners)
    return float(moved.norm(dim=-1).max()) / other.metrics["object_diameter"]


def test_groups_that_do_not_fit_follow_each_other(together: dict[tuple[int, int], BatchOutcome]) -> None:
    """Where the memory holds one pair, parts are smaller: results are the same up to rounding."""
    small = replace(TOGETHER, robust=replace(TOGETHER.robust, batch_memory=4 * 2**20))
    assert Sizes(4 * 2**20).pairs == 1 < Sizes(MEMORY).pairs
    pairs = [(0, 1), (0, 0)]
    for found, pair in zip(register(pairs, small), pairs, strict=True):
        assert_same_but_for_rounding(found, together[pair], BOXES[pair[0]])


def test_a_scale_that_is_known_and_a_symmetric_object() -> None:
    box = OrientedBox.from_corners([-0.55, -0.5, -0.02], [0.15, 0.2, 0.36])
    scene, pose = table_room(chair_pose(1.4)), chair_pose(1.4)
    scale = float(pose.scale)
    for bounds in ({}, {"min_scale": 0.9 * scale, "max_scale": 1.02 * scale}):
        one_by_one, fused = (
            RegistrationOptions.from_dict({"robust": {**QUICK, **bounds, **more}})
            for more in ({}, {"batch_memory": MEMORY})
        )
        (alone,), (found,) = (
            register_batch(scene, [box], [slab_table()], options=options, seed=1, clouds=False)
            for options in (one_by_one, fused)
        )
        assert alone.result is not None
        assert found.result is not None
        assert found.result.verdict == alone.result.verdict == "ambiguous"
        places = [one.T_object_scene for one in (found.result, *found.result.alternatives)]
        corners = box.corners()
        wanted = alone.result.T_object_scene.apply(corners)
        assert min(float((T.apply(corners) - wanted).norm(dim=-1).max()) for T in places) < 1e-4


def test_scenes_that_were_observed_in_part() -> None:
    """By an observation, each detection in a frame of its own."""
    low, voxel, count = torch.tensor([-1.2, -1.2, -0.3]).double(), 0.05, 48
    axes = [low[k] + (torch.arange(count) + 0.5) * voxel for k in range(3)]
    centers = torch.cartesian_prod(*axes).float()
    distance = SCENE.signed_distance(centers)
    states = torch.where(distance.abs() < 0.06, 2, torch.where(distance > 0, 1, 0))
    states[centers[:, 1] > 0.1] = 0  # nobody looked there
    scene = ObservedField(SCENE, Observation(states.to(torch.uint8).view(count, count, count), low, voxel))
    pairs = [(0, 0), (1, 0)]
    for found, alone in zip(register(pairs, scene=scene), register(pairs, ALONE, scene), strict=True):
        assert_same_but_for_rounding(found, alone, BOXES[found.detection])


class Faulty(AnalyticField):
    """Fails once it was asked as often as it takes to sample it."""

    def __init__(self, error: Exception | None) -> None:
        super().__init__(chair().formula, chair().bounds.tolist())
        self.error, self.sampled = error, False

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        value, gradient = super().signed_distance_and_gradient(points)
        if self.sampled and self.error is not None:
            raise self.error
        return (value * torch.nan if self.sampled else value), gradient


@pytest.mark.parametrize("error", [None, FieldFormatError("broken", reason="FIELD_INVALID")])
def test_a_field_that_fails_on_the_way_fails_alone(
    error: Exception | None, monkeypatch: pytest.MonkeyPatch, together: dict[tuple[int, int], BatchOutcome]
) -> None:
    faulty = Faulty(error)
    model = batch.model_object

    def sampled(obj: SdfField, options: object) -> object:
        found = model(obj, options)  # type: ignore[arg-type]
        faulty.sampled = True
        return found

    monkeypatch.setattr(batch, "model_object", sampled)
    found = register_batch(SCENE, BOXES, [faulty, chair()], [(0, 0), (0, 1)], TOGETHER, seed=3, clouds=False)
    assert found[0].error is not None
    assert found[0].error.reason == ("FIELD_NOT_FINITE" if error is None else "FIELD_INVALID")
    assert found[1].result is not None
    assert found[1].result.verdict == "registered"


def test_progress_grows_and_a_cancelled_batch_stops() -> None:
    reports: list[tuple[Phase, float]] = []

    def report(phase: Phase, done: float) -> None:
        reports.append((phase, done))

    register_batch(SCENE, BOXES, OBJECTS, [(0, 0), (1, 0)], TOGETHER, progress=report, clouds=False)
    shares = [done for _, done in reports]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert {phase for phase, _ in reports} == {"sampling", "initializing", "optimizing", "verifying", "exporting"}
    assert sum(phase == "optimizing" for phase, _ in reports) >= 19

    def cancel(phase: Phase, done: float) -> None:
        if phase == "optimizing":
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        register_batch(SCENE, BOXES, OBJECTS, [(0, 0), (1, 0)], TOGETHER, progress=cancel, clouds=False)


def test_clouds_are_added_where_they_are_wanted() -> None:
    (one,) = register_batch(SCENE, BOXES, OBJECTS, [(0, 0)], TOGETHER, seed=3)
    assert one.result is not None
    assert one.result.surroundings is not None
    assert one.result.metrics["field_evaluations_clouds"] > 0


@given(st.lists(st.integers(1, 90), min_size=1, max_size=6), st.sampled_from([32, 64]))
@settings(max_examples=40, deadline=None)
def test_parts_have_one_size_and_hold_every_pose_once(counts: list[int], size: int) -> None:
    parts = list(parts_of(counts, size, torch.device("cpu")))
    rows = torch.cat([part.rows[: size - part.filling] for part in parts])
    assert rows.tolist() == list(range(sum(counts)))
    owners = [number for number, count in enumerate(counts) for _ in range(count)]
    for part in parts:
        assert len(part.rows) == len(part.pairs) == size
        assert [owners[row] for row in part.rows.tolist()] == part.pairs.tolist()
        assert [pair for pair, count in part.runs for _ in range(count)] == part.pairs.tolist()
    assert sum(part.filling for part in parts[:-1]) == 0


def test_memory_bounds_parts_and_groups() -> None:
    assert Sizes(2**28).poses(64) == 4096
    assert Sizes(2**28).poses(700) == 256
    assert Sizes(2**22).poses(700) == 32
    assert Sizes(2**28).pairs == 64
    assert len(Sim3.cat([])) == 0
