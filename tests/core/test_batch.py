"""A batch gives what its pairs alone would give, and shares what they have in common."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.batch import ModeledObject, register_batch
from regnf_core.document import Phase, RegistrationResult
from regnf_core.errors import CancelledError, InvalidInputError, InvalidOptionsError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.library import model_object
from regnf_core.options import RegistrationOptions
from tests.core.analytic import chair, chair_pose, room, table
from tests.core.robust.shapes import ONE_SEARCH, ROBUST, detection

NOWHERE = OrientedBox.from_corners([0.2, -0.9, 0.5], [0.5, -0.6, 0.8])


def test_each_pair_ends_as_it_would_alone_and_a_faulty_one_spoils_no_other(
    plain: RegistrationResult, wrong: RegistrationResult
) -> None:
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
    for outcome, alone in zip(outcomes[2:], (plain, wrong), strict=True):
        assert outcome.result is not None
        assert outcome.result.verdict == alone.verdict
        assert torch.equal(outcome.result.T_object_scene.matrix(), alone.T_object_scene.matrix())
    assert reports == sorted(reports)
    assert reports[-1] == 1.0


def test_what_pairs_share_is_made_once_and_a_model_that_was_made_earlier_not_at_all() -> None:
    scene, obj, made = CountingField(room(chair_pose())), CountingField(chair()), CountingField(chair())

    def evaluations(objects: list[SdfField | ModeledObject], pairs: list[tuple[int, int]]) -> tuple[int, int, Tensor]:
        before = scene.evaluations, obj.evaluations
        (first, *_) = register_batch(scene, [detection()], objects, pairs=pairs, options=ROBUST, clouds=False)
        assert first.result is not None
        return scene.evaluations - before[0], obj.evaluations - before[1], first.result.T_object_scene.matrix()

    of_scene, of_object, pose = evaluations([obj], [(0, 0)])
    of_scene_twice, of_object_twice, _ = evaluations([obj, obj], [(0, 0), (0, 0)])
    assert of_scene_twice < 1.9 * of_scene
    assert of_object_twice < 1.9 * of_object
    _, of_modeled, same = evaluations([ModeledObject(obj, model_object(made))], [(0, 0)])
    assert of_modeled == of_object - made.evaluations < of_object
    assert torch.equal(pose, same)


def test_an_unknown_pair_is_refused_before_any_work() -> None:
    scene = CountingField(room(chair_pose()))
    for pair in ((0, 1), (1, 0), (-1, 0)):
        with pytest.raises(InvalidInputError) as raised:
            register_batch(scene, [detection()], [chair()], pairs=[pair], options=ROBUST)
        assert raised.value.reason == "PAIR_UNKNOWN"
    assert scene.evaluations == 0


def test_options_of_another_preset_are_refused_before_any_work() -> None:
    scene = CountingField(room(chair_pose()))
    with pytest.raises(InvalidOptionsError, match="registers a batch"):
        register_batch(scene, [detection()], [chair()], options=RegistrationOptions(preset="paper"))
    assert scene.evaluations == 0


def test_a_cancelled_batch_stops() -> None:
    def cancel(phase: Phase, done: float) -> None:
        if done > 0.1:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        register_batch(room(chair_pose()), [detection()] * 2, [chair()], options=ROBUST, progress=cancel, clouds=False)
