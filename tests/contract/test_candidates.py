"""A file that may be one of several functions: the field's error has each of them, with a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from regnf_core.errors import Candidate, FieldFormatError
from regnf_state.queue import Work
from regnf_state.room import Originals
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from tests.contract.test_field_changes import ORIGINAL, PLACE, A, change, imported, send
from tests.contract.world import World, assert_refused, make_world, sha256

SMOOTH, LINEAR = ({"hash": {"interpolation": kind}} for kind in ("smoothstep", "linear"))
ASKED = (Candidate("smooth", SMOOTH, b"\x89PNG smooth"), Candidate("linear", LINEAR), Candidate("c", {}, b"\x89PNG c"))
PICTURES = {f"fields/{sha256(A)}/candidates/{number}.png" for number in (1, 3)}


def asked_about(world: World, asked: Sequence[Candidate] = ASKED, reason: str = "LAYOUT_AMBIGUOUS") -> None:
    """The import that waits ends with a question."""

    def importer(*_: Any) -> dict[str, Any]:
        raise FieldFormatError("which one is it?", reason=reason, candidates=asked)

    reference, attempt = world.queue.imports[-1]
    world.queue.remove(Work("import", reference, attempt).name)
    context = Context(world.settings, world.records, world.blobs, world.queue)
    run_import_attempt(context, reference, attempt, "w", importer)


def candidates(world: World, prefix: str = "") -> Any:
    return world.client.get(prefix + PLACE).json()["error"]["candidates"]


def test_each_has_what_to_say_and_its_picture(world: World) -> None:
    send(world, {"label": "chair"})
    asked_about(world)
    first, second, third = candidates(world, "/v1")
    assert first == {"name": "smooth", "description": SMOOTH, "picture": f"/v1{PLACE}/candidates/1.png"}
    assert second == {"name": "linear", "description": LINEAR, "picture": None}
    answer = world.client.get(third["picture"])
    assert (answer.status_code, answer.content, answer.headers["content-type"]) == (200, b"\x89PNG c", "image/png")
    assert world.client.head(first["picture"]).status_code == 200


@pytest.mark.parametrize("number", ["0", "2", "4", "7", "01", "+1", "\u0661", "-1", "1.png", "..%2foriginal", "x"])
def test_there_is_no_other_picture(world: World, number: str) -> None:
    send(world)
    asked_about(world)
    answer = world.client.get(f"{PLACE}/candidates/{number}.png")
    assert answer.status_code == 404
    assert world.client.get(f"{PLACE}/candidates/1.png").status_code == 200


def test_an_answer_makes_the_question_and_its_pictures_go(world: World) -> None:
    send(world)
    asked_about(world)
    assert set(world.blobs.blobs) == {ORIGINAL, *PICTURES}
    assert change(world, description=candidates(world)[0]["description"]).status_code == 202
    assert_refused(world.client.get(f"{PLACE}/candidates/1.png"), 404, "FIELD_PREVIEW_NOT_FOUND")
    imported(world)
    document = world.client.get(PLACE).json()
    assert (document["state"], document["description"], document["error"]) == ("ready", SMOOTH, None)
    assert PICTURES.isdisjoint(world.blobs.blobs)


def test_another_question_takes_the_place_of_the_first(world: World) -> None:
    send(world)
    asked_about(world)
    change(world, description=SMOOTH)
    asked_about(world, [Candidate("of two", {"sign": 1}), Candidate("the other", {"sign": -1}, b"\x89PNG -")])
    assert [one["name"] for one in candidates(world)] == ["of two", "the other"]
    assert set(world.blobs.blobs) == {ORIGINAL, f"fields/{sha256(A)}/candidates/2.png"}


def test_pictures_go_with_the_upload(world: World) -> None:
    send(world)
    asked_about(world)
    assert Originals(world.records, world.blobs, world.settings).free("anonymous")
    assert world.blobs.blobs == {}
    assert [one["picture"] for one in candidates(world)] == [None] * 3
    assert_refused(world.client.get(f"{PLACE}/candidates/1.png"), 404, "FIELD_PREVIEW_NOT_FOUND")


def test_pictures_go_with_the_field(world: World) -> None:
    send(world)
    asked_about(world)
    assert world.client.delete(PLACE).status_code == 204
    assert world.blobs.blobs == {}


def test_without_a_kept_upload_there_are_no_pictures(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, keep_originals="none")
    send(world)
    asked_about(world)
    assert world.blobs.blobs == {}
    assert [one["picture"] for one in candidates(world)] == [None] * 3
    assert [one["description"] for one in candidates(world)] == [SMOOTH, LINEAR, {}]


def test_the_same_bytes_are_asked_about_again_without_an_import(world: World) -> None:
    """A rejection is remembered; its pictures are not."""
    send(world)
    asked_about(world)
    world.client.delete(PLACE)
    assert send(world).json()["state"] == "rejected"
    assert [one["picture"] for one in candidates(world)] == [None] * 3
    assert change(world, description=SMOOTH).status_code == 202


def test_other_rejections_have_no_candidates(world: World) -> None:
    send(world)
    asked_about(world, (), "LATENT_MISSING")
    assert "candidates" not in world.client.get(PLACE).json()["error"]
