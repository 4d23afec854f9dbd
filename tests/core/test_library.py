"""Library search: the right object first, only a few fields opened, the same answer every time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest
import torch

from regnf_core.batch import ModeledObject, register_batch
from regnf_core.document import Phase
from regnf_core.errors import CancelledError, InvalidInputError, InvalidOptionsError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.library import LibraryObject, model_object, search_library
from regnf_core.options import RegistrationOptions
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, sphere, table
from tests.core.robust.shapes import ONE_SEARCH, ROBUST, alone, can, detection, placement_error, slab_table


def cupboards(count: int) -> dict[str, AnalyticField]:
    """Boxes of different proportions, each with a foot of its own."""
    found = {}
    for k in range(count):
        width, depth = 0.15 + 0.03 * k, 0.45 - 0.02 * k
        found[f"cupboard-{k}"] = boxes(
            [([-width, -depth, -0.3], [width, depth, 0.3]), ([-0.05, -0.05, -0.4], [0.1, 0.05, -0.3])]
        )
    return found


def library(shapes: dict[str, AnalyticField], opened: Counter[str]) -> list[LibraryObject]:
    def opener(name: str, field: AnalyticField) -> Callable[[], SdfField]:
        def open_it() -> SdfField:
            opened[name] += 1
            return field

        return open_it

    return [LibraryObject(name, opener(name, field), model_object(field)) for name, field in shapes.items()]


def test_the_right_object_comes_first_and_few_fields_are_opened() -> None:
    shapes = {"table": table(), "ball": sphere(0.4), **cupboards(8), "chair": chair(), "can": can(), "s": slab_table()}
    opened: Counter[str] = Counter()
    reports: list[tuple[str, float]] = []
    found = search_library(
        room(chair_pose()),
        detection(),
        library(shapes, opened),
        ROBUST,
        progress=lambda phase, done: reports.append((phase, done)),
    )
    assert found.ranking[0].name == "chair"
    assert found.ranking[0].verdict == found.result.verdict == "registered"
    assert placement_error(found.result, chair_pose()) < 0.005
    assert found.ranking[0].T_object_scene is found.result.T_object_scene
    assert sorted(one.name for one in found.ranking) == sorted(shapes)
    stages = [one.stage for one in found.ranking]
    assert stages == sorted(stages, key=["refined", "coarse", "signature"].index)
    assert stages.count("signature") == len(shapes) - 12
    assert set(opened) == {one.name for one in found.ranking if one.stage == "refined"}
    assert len(opened) <= 4
    assert [done for _, done in reports] == sorted(done for _, done in reports)
    assert len(found.result.residuals["scene_residuals"]) > 1000


def test_a_search_with_the_same_seed_and_without_clouds_has_the_same_numbers_and_evaluates_less() -> None:
    evaluations, found, rankings = [], [], []
    for clouds in (True, False):
        scene = CountingField(room(chair_pose()))
        some = library({"table": table(), "chair": chair()}, Counter())
        searched = search_library(scene, detection(), some, ROBUST, seed=3, clouds=clouds)
        rankings.append([(one.name, one.score) for one in searched.ranking])
        found.append(searched.result)
        evaluations.append(scene.evaluations)
    with_clouds, without = found
    assert rankings[0] == rankings[1]
    assert evaluations[1] < evaluations[0]
    assert (bool(with_clouds.residuals), without.residuals) == (True, {})
    torch.testing.assert_close(with_clouds.T_object_scene.matrix(), without.T_object_scene.matrix(), rtol=0, atol=0)
    numbers = [
        {name: value for name, value in one.metrics.items() if not name.startswith(("seconds", "field_evaluations"))}
        for one in found
    ]
    assert numbers[0] == numbers[1]


def test_a_library_without_the_object_ends_in_a_rejection() -> None:
    shapes = {"table": table(), "ball": sphere(0.4), "can": can()}
    found = search_library(room(chair_pose()), detection(), library(shapes, Counter()), ONE_SEARCH, clouds=False)
    assert found.result.verdict == "rejected"
    assert {one.verdict for one in found.ranking} <= {"rejected", None}


def test_an_empty_library_is_refused() -> None:
    with pytest.raises(InvalidInputError) as raised:
        search_library(room(chair_pose()), detection(), [], ROBUST)
    assert raised.value.reason == "LIBRARY_EMPTY"


# A batch gives what its pairs alone would give, and shares what they have in common.


NOWHERE = OrientedBox.from_corners([0.2, -0.9, 0.5], [0.5, -0.6, 0.8])


def test_each_pair_ends_as_it_would_alone_and_a_faulty_one_spoils_no_other() -> None:
    reports: list[float] = []
    outcomes = register_batch(
        room(chair_pose()),
        [NOWHERE, detection()],
        [chair(), table()],
        options=ONE_SEARCH,
        progress=lambda phase, done: reports.append(done),
        clouds=False,
    )
    assert [(one.detection, one.object) for one in outcomes] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert [one.error.reason if one.error else None for one in outcomes] == ["NO_SURFACE_IN_DETECTION"] * 2 + [None] * 2
    for outcome, obj in zip(outcomes[2:], (chair, table), strict=True):
        expected = alone(obj, ONE_SEARCH).result
        assert outcome.result is not None
        assert outcome.result.verdict == expected.verdict
        assert torch.equal(outcome.result.T_object_scene.matrix(), expected.T_object_scene.matrix())
    assert reports == sorted(reports)
    assert reports[-1] == 1.0


def test_what_pairs_share_is_made_once() -> None:
    scene, obj = CountingField(room(chair_pose())), CountingField(chair())
    register_batch(scene, [detection()], [obj, obj], pairs=[(0, 0), (0, 0)], options=ONE_SEARCH, clouds=False)
    assert scene.evaluations < 1.9 * alone(chair, ONE_SEARCH).of_scene
    assert obj.evaluations < 1.9 * alone(chair, ONE_SEARCH).of_object


def test_a_model_that_was_made_earlier_saves_making_it() -> None:
    made, obj, plain = CountingField(chair()), CountingField(chair()), alone(chair, ONE_SEARCH)
    known = ModeledObject(obj, model_object(made))
    (found,) = register_batch(room(chair_pose()), [detection()], [known], options=ONE_SEARCH, clouds=False)
    assert obj.evaluations == plain.of_object - made.evaluations < plain.of_object
    assert found.result is not None
    assert torch.equal(found.result.T_object_scene.matrix(), plain.result.T_object_scene.matrix())


def test_an_unknown_pair_is_refused_before_any_work() -> None:
    scene = CountingField(room(chair_pose()))
    for pair in ((0, 1), (1, 0), (-1, 0)):
        with pytest.raises(InvalidInputError) as raised:
            register_batch(scene, [detection()], [chair()], pairs=[pair], options=ROBUST)
        assert raised.value.reason == "PAIR_UNKNOWN"
    assert scene.evaluations == 0


CHAIR = LibraryObject("chair", chair, model_object(chair()))


@pytest.mark.parametrize(
    ("reason", "work"),
    [
        ("INVALID_OPTIONS", lambda scene, options: register_batch(scene, [detection()], [chair()], options=options)),
        ("PRESET_UNSUITABLE", lambda scene, options: search_library(scene, detection(), [CHAIR], options)),
    ],
)
def test_options_of_another_preset_are_refused_before_any_work(reason: str, work: Callable[..., object]) -> None:
    scene = CountingField(room(chair_pose()))
    with pytest.raises(InvalidOptionsError) as raised:
        work(scene, RegistrationOptions(preset="paper"))
    assert raised.value.reason == reason
    assert scene.evaluations == 0


def test_a_cancelled_batch_stops() -> None:
    def cancel(phase: Phase, done: float) -> None:
        if done > 0.1:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        register_batch(room(chair_pose()), [detection()] * 2, [chair()], options=ROBUST, progress=cancel, clouds=False)
