"""Library search: the right object first, only a few fields opened, the same answer every time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest
import torch

from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.fields.observation import CountingField, SdfField
from regnf_core.library import LibraryObject, model_object, search_library
from regnf_core.options import RegistrationOptions
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, sphere, table
from tests.core.robust.shapes import ONE_SEARCH, ROBUST, can, detection, placement_error, slab_table


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
    shapes = {"table": table(), "ball": sphere(0.4), **cupboards(9), "chair": chair(), "can": can(), "s": slab_table()}
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


def test_options_of_another_preset_are_refused_before_any_work() -> None:
    scene, paper = CountingField(room(chair_pose())), RegistrationOptions(preset="paper")
    with pytest.raises(InvalidOptionsError) as raised:
        search_library(scene, detection(), library({"chair": chair()}, Counter()), paper)
    assert raised.value.reason == "PRESET_UNSUITABLE"
    assert scene.evaluations == 0
