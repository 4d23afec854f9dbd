"""A batch gives what its pairs alone would give, and shares what they have in common."""

from __future__ import annotations

import pytest
import torch

from regnf_core.batch import ModeledObject, register_batch
from regnf_core.document import Phase
from regnf_core.errors import CancelledError, InvalidInputError, InvalidOptionsError
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.library import model_object, register
from regnf_core.options import RegistrationOptions
from tests.core.analytic import chair, chair_pose, room, table
from tests.core.robust.shapes import ROBUST, detection

NOWHERE = OrientedBox.from_corners([0.2, -0.9, 0.5], [0.5, -0.6, 0.8])


def test_each_pair_ends_as_it_would_alone_and_a_faulty_one_spoils_no_other() -> None:
    scene = room(chair_pose())
    reports: list[float] = []
    outcomes = register_batch(
        scene,
        [NOWHERE, detection()],
        [chair(), table()],
        options=ROBUST,
        seed=3,
        progress=lambda phase, done: reports.append(done),
        clouds=False,
    )
    assert [(one.detection, one.object) for one in outcomes] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert [one.error.reason if one.error else None for one in outcomes] == ["NO_SURFACE_IN_DETECTION"] * 2 + [None] * 2
    for outcome, obj in zip(outcomes[2:], (chair(), table()), strict=True):
        alone = register(scene, obj, detection(), ROBUST, seed=3, clouds=False)
        assert outcome.result is not None
        assert outcome.result.verdict == alone.verdict
        torch.testing.assert_close(
            outcome.result.T_object_scene.matrix(), alone.T_object_scene.matrix(), rtol=0, atol=0
        )
    assert reports == sorted(reports)
    assert reports[-1] == 1.0


def test_what_pairs_share_is_made_once() -> None:
    scene, obj = CountingField(room(chair_pose())), CountingField(chair())
    register_batch(scene, [detection()], [obj], options=ROBUST, clouds=False)
    of_scene, of_object = scene.evaluations, obj.evaluations
    register_batch(scene, [detection()], [obj, obj], pairs=[(0, 0), (0, 0)], options=ROBUST, clouds=False)
    assert scene.evaluations - of_scene < 1.9 * of_scene
    assert obj.evaluations - of_object < 1.9 * of_object


def test_a_model_that_was_made_earlier_saves_making_it() -> None:
    scene, obj = room(chair_pose()), CountingField(chair())
    made = CountingField(chair())
    model = model_object(made)
    (plain,) = register_batch(scene, [detection()], [obj], options=ROBUST, clouds=False)
    without = obj.evaluations
    (known,) = register_batch(scene, [detection()], [ModeledObject(obj, model)], options=ROBUST, clouds=False)
    assert obj.evaluations - without == without - made.evaluations < without
    assert plain.result is not None
    assert known.result is not None
    assert torch.equal(plain.result.T_object_scene.matrix(), known.result.T_object_scene.matrix())


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
        if done > 0.5:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        register_batch(room(chair_pose()), [detection()] * 2, [chair()], options=ROBUST, progress=cancel, clouds=False)
