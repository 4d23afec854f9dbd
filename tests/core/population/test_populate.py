"""A whole scene populated, and two scenes compared."""

from __future__ import annotations

import json

import numpy as np
import pytest

from regnf_core.errors import CancelledError, InvalidInputError, InvalidOptionsError
from regnf_core.options import RegistrationOptions, RobustOptions
from regnf_core.population.compare import compare
from regnf_core.population.populate import Population, populate
from tests.core.population.rooms import bracket, chair, error_of, lamp, library, pose, room, table

KNOWN = RegistrationOptions(robust=RobustOptions(min_scale=0.97, max_scale=1.03))
MESHES = {"chair": chair(), "table": table(), "bracket": bracket(), "lamp": lamp()}
PLACES = {
    "chair": [pose(-0.9, -0.6, 0.0, 20.0), pose(1.2, -0.9, 0.0, 140.0)],
    "table": [pose(0.5, 0.5, 0.0, 75.0)],
    "bracket": [pose(0.45, 0.35, 0.72, 200.0)],
}
LIBRARY = library(**MESHES)


def scene(places: dict[str, list[np.ndarray]]) -> object:
    return room([(MESHES[name], T) for name, poses in places.items() for T in poses])


@pytest.fixture(scope="module")
def found() -> Population:
    return populate(scene(PLACES), LIBRARY, KNOWN)  # type: ignore[arg-type]


def test_every_thing_is_placed_once_and_nothing_else(found: Population) -> None:
    left = {name: list(poses) for name, poses in PLACES.items()}
    for one in found.placements:
        errors = [error_of(MESHES[one.name], one.T_scene_object, T) for T in left[one.name]]
        assert min(errors) < 0.02, (one.name, errors)
        left[one.name].pop(int(np.argmin(errors)))
        assert one.probability >= 0.8
    assert not any(left.values())


def test_the_document_has_the_poses_the_boxes_and_what_is_left(found: Population) -> None:
    told = json.loads(json.dumps(found.to_dict()))
    assert [one["object"] for one in told["placements"]] == [one.name for one in found.placements]
    first = told["placements"][0]
    there, back = (np.array(first[name]["matrix"]) for name in ("T_scene_object", "T_object_scene"))
    assert np.allclose(there @ back, np.eye(4), atol=1e-9)
    assert np.allclose(told["up"], [0, 0, 1], atol=1e-3)
    assert told["unexplained_share"] < 0.1
    for one in found.placements:
        mesh = MESHES[one.name]
        corners = one.T_scene_object.apply(found.library[one.number].model.bounds).numpy()
        assert found.box(one).contains(found.box(one).center[None]).all()
        assert np.isfinite(corners).all()
        assert float(found.box(one).size.max()) >= np.ptp(mesh.vertices, axis=0).max()


def test_a_wrong_object_alone_is_not_placed() -> None:
    found = populate(scene(PLACES), library(lamp=MESHES["lamp"]), KNOWN)  # type: ignore[arg-type]
    assert found.placements == []
    assert found.free.all()
    assert len(found.unexplained) >= 3


def test_the_number_of_processes_changes_nothing(found: Population) -> None:
    again = populate(scene(PLACES), LIBRARY, KNOWN, processes=2)  # type: ignore[arg-type]
    assert [one.name for one in again.placements] == [one.name for one in found.placements]
    for one, other in zip(again.placements, found.placements, strict=True):
        assert np.array_equal(one.T_scene_object.matrix().numpy(), other.T_scene_object.matrix().numpy())


def test_progress_is_told_and_may_cancel() -> None:
    shares: list[float] = []

    def watch(share: float, placed: object) -> None:
        shares.append(share)
        if share > 0:
            raise CancelledError("stop")

    with pytest.raises(CancelledError):
        populate(scene(PLACES), LIBRARY, KNOWN, watch=watch)  # type: ignore[arg-type]
    assert shares[0] == 0.0


def test_options_of_the_other_preset_and_an_empty_library_are_refused() -> None:
    with pytest.raises(InvalidOptionsError):
        populate(scene(PLACES), LIBRARY, RegistrationOptions(preset="paper"))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError) as refused:
        populate(scene(PLACES), [], KNOWN)  # type: ignore[arg-type]
    assert refused.value.reason == "LIBRARY_EMPTY"


def test_what_moved_is_gone_or_is_new_is_told(found: Population) -> None:
    later = dict(PLACES)
    later["chair"] = [PLACES["chair"][0], pose(0.9, -0.9, 0.0, 100.0)]
    later["bracket"] = []
    later["lamp"] = [pose(-1.2, 0.9, 0.0, 0.0)]
    before, after = scene(PLACES), scene(later)
    second = populate(after, LIBRARY, KNOWN)  # type: ignore[arg-type]
    changes = compare((before, found), (after, second), LIBRARY)  # type: ignore[arg-type]
    told = sorted((one.change, one.name) for one in changes)
    assert told == [
        ("gone", "bracket"), ("moved", "chair"), ("new", "lamp"), ("stayed", "chair"), ("stayed", "table"),
    ]  # fmt: skip
    moved = next(one for one in changes if one.change == "moved")
    center = np.append(found.library[0].model.frame.center.numpy(), 1.0)
    true = (later["chair"][1] @ center - PLACES["chair"][1] @ center)[:3]
    assert moved.moved == pytest.approx(float(np.linalg.norm(true)), abs=0.005)
