"""The option ``min_probability`` on every way to an answer: none below it is accepted, and those from it on are."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from regnf_core import RegistrationOptions, RegistrationResult, register, register_batch
from regnf_core.document import result_document
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, model_object, search_library
from tests.core.analytic import chair, chair_box, chair_pose, room, table
from tests.core.robust.shapes import slab_table, table_room
from tests.golden.cases import SLAB_BOX

NEAR = Sim3.from_quaternion(1.02, [0.02, -0.03, 0.04, 1.0], [0.02, -0.01, 0.02]) @ chair_pose()
Way = Callable[[RegistrationOptions], RegistrationResult]


def registered(options: RegistrationOptions) -> RegistrationResult:
    return register(room(chair_pose()), chair(), chair_box(chair_pose()), options, clouds=False)


def started(options: RegistrationOptions) -> RegistrationResult:
    return register(room(chair_pose()), chair(), chair_box(chair_pose()), options, initial_transform=NEAR, clouds=False)


def ambiguous(options: RegistrationOptions) -> RegistrationResult:
    return register(table_room(chair_pose(1.4)), slab_table(), SLAB_BOX, options, clouds=False)


def in_batch(options: RegistrationOptions) -> RegistrationResult:
    box = chair_box(chair_pose())
    found = register_batch(room(chair_pose()), [box], [chair()], options=options)
    assert found[0].result is not None
    return found[0].result


def searched(options: RegistrationOptions) -> RegistrationResult:
    shapes = {"table": table(), "chair": chair()}
    library = [LibraryObject(name, partial(shapes.__getitem__, name), model_object(shapes[name])) for name in shapes]
    found = search_library(room(chair_pose()), chair_box(chair_pose()), library, options)
    first = found.ranking[0]
    assert (first.name, first.verdict, first.probability) == ("chair", found.result.verdict, found.result.probability)
    assert all(one.verdict == "rejected" for one in found.ranking[1:] if one.verdict)
    return found.result


WAYS: dict[str, Way] = {
    "register": registered,
    "from a start": started,
    "ambiguous": ambiguous,
    "batch": in_batch,
    "search": searched,
}


@pytest.mark.parametrize("way", WAYS)
def test_above_its_probability_no_answer_is_accepted(way: str) -> None:
    found = WAYS[way](RegistrationOptions.from_dict({"robust": {"min_probability": 1.0, "feature_draws": 0}}))
    assert found.probability is not None
    assert 0.9 <= found.probability < 1.0, "a right answer, which the default accepts"
    assert (found.verdict, found.verdict_reason) == ("rejected", "LOW_PROBABILITY")
    document = result_document(found)
    assert document["probability"] == document["metrics"]["probability"] == found.probability
    assert "at least" in document["verdict_detail"]
    assert document["considered"][0]["metrics"]["probability"] == found.probability
