"""What comes beside a field's file, what an import asks about, and what is said of the field afterwards."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import httpx
import pytest

from regnf_core.errors import Candidate, FieldFormatError
from regnf_state.queue import Work
from regnf_state.room import Originals
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from tests.contract.test_registrations import one_shot
from tests.contract.world import BOX, World, assert_refused, field_bytes, put, sha256
from tests.worker.tiny_engine import tiny_importer

A = field_bytes("a")
PLACE, FOLDER = f"/fields/{sha256(A)}", f"fields/{sha256(A)}"
ORIGINAL = f"{FOLDER}/original"
IMPORTED = {f"{FOLDER}/{name}" for name in ("field.safetensors", "report.json")}
CONFIG = b"method: neus\n"
SETTINGS = f"{FOLDER}/settings-{sha256(CONFIG)}"
BESIDE = ("config.yml", CONFIG)
MESH = b"ply\nformat ascii 1.0\n".ljust(600)
Worlds = Callable[..., World]


def send(
    world: World, said: Any = None, settings: tuple[str, bytes] | None = None, data: bytes = A, **parts: Any
) -> httpx.Response:
    files: dict[str, Any] = {"file": ("a.ckpt", data), **parts}
    if said is not None:
        files["description"] = (None, json.dumps(said), "application/json")
    if settings is not None:
        files["settings"] = settings
    return world.client.post("/fields", files=files)


def imported(world: World, reason: str | None = None, asked: Sequence[Candidate] = ()) -> None:
    """The import that waits is done: well, or refused for ``reason``."""

    def importer(*given: Any) -> dict[str, Any]:
        if reason is not None:
            raise FieldFormatError("which one is it?", reason=reason, candidates=asked)
        return tiny_importer(*given)

    reference, attempt = world.queue.imports[-1]
    world.queue.remove(Work("import", reference, attempt).name)
    context = Context(world.settings, world.records, world.blobs, world.queue)
    run_import_attempt(context, reference, attempt, "w", importer)


def change(world: World, **values: Any) -> httpx.Response:
    return world.client.patch(PLACE, json=values)


def now(world: World) -> dict[str, Any]:
    document: dict[str, Any] = world.client.get(PLACE).json()
    return document


# beside the file


def test_settings_and_cameras_are_stored_beside_the_file_and_make_another_function_of_it(world: World) -> None:
    poses = b"0 0 0 0 0 0 0 1\n"
    said = {"cameras": {"intrinsics": [1.0, 1.0, 1.0, 1.0]}}
    answer = send(world, said, ("runs/1/config.yml", CONFIG), cameras=("walk/poses.txt", poses))
    assert answer.status_code == 201, answer.text
    document = answer.json()
    assert (document["description"], document["bytes"]) == (said, len(A))
    assert document["settings"] == {"name": "config.yml", "sha256": sha256(CONFIG), "bytes": len(CONFIG)}
    assert document["cameras"] == {"name": "poses.txt", "sha256": sha256(poses), "bytes": len(poses)}
    assert world.blobs.blobs == {ORIGINAL: A, SETTINGS: CONFIG, f"{FOLDER}/settings-{sha256(poses)}": poses}
    assert_refused(send(world, said, BESIDE), 409, "FIELD_DESCRIPTION_DIFFERS")
    imported(world)
    assert set(world.blobs.blobs) == IMPORTED
    assert now(world)["settings"]["name"] == "config.yml"


def test_a_name_of_settings_is_a_plain_name(world: World) -> None:
    plain = {
        "C:\\runs\\config.yml": "config.yml", "../../../etc/passwd": "passwd", "..": "settings",
        ".hidden.yml": "hidden.yml", "a b\u00e4.yml": "a_b__.yml", "x" * 300 + ".yml": "x" * 96 + ".yml",
    }  # fmt: skip
    for filename, name in plain.items():
        assert send(world, None, (filename, CONFIG)).json()["settings"]["name"] == name
        assert world.client.delete(PLACE).status_code == 204


def test_the_same_bytes_with_other_settings_are_another_function(world: World) -> None:
    assert send(world, None, BESIDE).status_code == 201
    assert send(world, None, ("renamed.yml", CONFIG)).status_code == 200
    assert send(world, {"label": "room"}, BESIDE).json()["label"] == "room"
    for said, settings in ((None, ("config.yml", b"other")), ({"sign": -1}, BESIDE), ({"sign": -1}, None)):
        assert_refused(send(world, said, settings), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert put(world.client, A).status_code == 200
    assert world.blobs.blobs == {ORIGINAL: A, SETTINGS: CONFIG}


def test_settings_have_their_limit_are_not_empty_and_count_towards_the_quota(worlds: Worlds) -> None:
    world = worlds(quota_stored_bytes=1000)
    assert_refused(send(world, None, ("config.yml", b"x" * 5000)), 413, "UPLOAD_TOO_LARGE")
    assert_refused(send(world, None, ("config.yml", b"")), 400, "UPLOAD_INCOMPLETE")
    assert_refused(send(world, None, ("config.yml", b"x" * 500)), 403, "QUOTA_STORED")
    assert world.blobs.blobs == {}
    assert send(world, None, ("config.yml", b"x" * 300)).status_code == 201
    assert world.records.stored("anonymous") == (1, 900)


def test_one_shot_takes_settings_and_descriptions_of_both(world: World) -> None:
    scene, object_ = field_bytes("one"), field_bytes("two")
    files = one_shot(scene, object_, {"detection": BOX}) | {
        "scene_settings": BESIDE,
        "object_description": (None, '{"latent_index": 3, "label": "chair"}', "application/json"),
    }
    answer = world.client.post("/register", files=files)
    assert answer.status_code == 202, answer.text
    held = [world.client.get(f"/fields/{sha256(data)}").json() for data in (scene, object_)]
    assert held[0]["settings"]["sha256"] == sha256(CONFIG)
    assert (held[1]["description"], held[1]["label"]) == ({"latent_index": 3}, "chair")
    faulty = files | {"object_description": (None, '{"sign": 3}', "application/json")}
    assert_refused(world.client.post("/register", files=faulty), 422, "INVALID_DESCRIPTION")


def test_a_mesh_is_read_as_what_it_is_used_as_unless_it_is_held(world: World) -> None:
    other = MESH + b"."
    assert send(world, data=other).status_code == 201
    assert world.client.post("/register", files=one_shot(MESH, other, {"detection": BOX})).status_code == 202
    descriptions = [world.client.get(f"/fields/{sha256(data)}").json()["description"] for data in (MESH, other)]
    assert descriptions == [{"as": "scene"}, {}]
    assert send(world, {"label": "room"}, data=MESH).status_code == 200
    assert_refused(send(world, {"as": "object"}, data=MESH), 409, "FIELD_DESCRIPTION_DIFFERS")


# what is said afterwards


def test_a_question_is_answered_without_a_second_upload(world: World) -> None:
    send(world, {"level_mask": 4, "hash": {"levels": 16}}, BESIDE)
    imported(world, "LATENT_MISSING")
    document = now(world)
    assert (document["state"], document["error"]["reason"]) == ("rejected", "LATENT_MISSING")
    assert document["kept_until"] > document["updated_at"]
    assert {"original_until", "candidates"}.isdisjoint(document["error"])
    answer = change(world, description={"latent_index": 3, "level_mask": None, "hash": {"base_resolution": 16}})
    assert answer.status_code == 202, answer.text
    told = answer.json()
    assert (told["state"], told["error"], told["kept_until"]) == ("validating", None, None)
    assert told["description"] == {"latent_index": 3, "hash": {"levels": 16, "base_resolution": 16}}
    assert world.queue.imports == [(sha256(A), 2)]
    imported(world)
    assert now(world)["state"] == "ready"
    assert set(world.blobs.blobs) == IMPORTED
    assert_refused(change(world, description={"latent_index": 4}), 409, "FIELD_BYTES_GONE")


def test_a_label_is_changed_in_place(world: World) -> None:
    world.ready_field("a")
    assert change(world, label="chair").json()["label"] == "chair"
    assert change(world, description={}).json()["label"] == "chair"
    assert change(world, description={"label": "room"}).json()["label"] == "room"
    headers = {"Content-Type": "application/merge-patch+json"}
    assert world.client.patch(PLACE, content=b'{"label": "x"}', headers=headers).json()["label"] == "x"
    answer = change(world, label=None)
    assert (answer.status_code, answer.json()["label"], answer.json()["state"]) == (200, None, "ready")
    assert world.queue.imports == []


def test_a_ready_field_is_imported_anew_where_its_bytes_are_kept(worlds: Worlds) -> None:
    world = worlds(keep_originals="all")
    send(world, {"sign": -1})
    imported(world)
    assert (now(world)["state"], now(world)["kept_until"] is not None) == ("ready", True)
    assert "original_until" not in now(world)["report"]
    assert change(world, description=None).status_code == 202
    imported(world)
    assert now(world)["description"] == {}
    assert world.client.delete(PLACE).status_code == 204
    assert (world.blobs.blobs, world.records.stored("anonymous")) == ({}, (0, 0))


def test_what_an_active_job_uses_keeps_its_function(worlds: Worlds, monkeypatch: pytest.MonkeyPatch) -> None:
    world = worlds(keep_originals="all")
    send(world)
    imported(world)
    job_id = world.submit(object=sha256(A))
    assert_refused(change(world, description={"sign": -1}), 409, "FIELD_IN_USE")
    world.succeed(job_id)
    before, waiting = now(world), world.queue.imports
    with monkeypatch.context() as patch:  # a job comes in between
        answers = iter([[], ["job"]])
        patch.setattr(world.records, "jobs_using_field", lambda _: iter(next(answers)))
        assert_refused(change(world, description={"sign": -1}), 409, "FIELD_IN_USE")
    same = ("state", "description", "report", "kept_until")
    assert [now(world)[name] for name in same] == [before[name] for name in same]
    assert world.queue.imports == waiting
    assert change(world, description={"sign": -1}).status_code == 202
    imported(world)
    assert world.submit(object=sha256(A)) != job_id, "the result of another function is no answer"


def test_changes_that_are_refused(world: World) -> None:
    send(world)
    wrong: list[tuple[Any, int, str]] = [
        *(
            ({"description": one}, 422, "INVALID_DESCRIPTION")
            for one in ({"sign": 3}, {"sing": 1}, {"settings": {"name": "x"}})
        ),
        *((one, 422, "INVALID_REQUEST") for one in ({"description": []}, {"sign": -1}, {"label": ""}, [])),
        ({"description": {"sign": -1}}, 409, "FIELD_VALIDATING"),
    ]
    for body, status, reason in wrong:
        problem = assert_refused(world.client.patch(PLACE, json=body), status, reason)
        assert reason != "INVALID_DESCRIPTION" or problem["errors"][0]["pointer"].startswith("/description/s")
        assert now(world)["description"] == {}
    answer = world.client.patch(PLACE, content=b"sign=-1", headers={"Content-Type": "text/plain"})
    assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")


# room


def question(world: World, name: str) -> str:
    send(world, data=field_bytes(name))
    imported(world, "LATENT_MISSING")
    return f"fields/{sha256(field_bytes(name))}/original"


def test_kept_bytes_count_and_give_way(worlds: Worlds) -> None:
    world = worlds(quota_stored_bytes=1300)
    first, second = question(world, "1"), question(world, "2")
    assert world.records.stored("anonymous") == (2, 1200)
    assert send(world, data=field_bytes("3")).status_code == 201
    assert set(world.blobs.blobs) == {second, f"fields/{sha256(field_bytes('3'))}/original"}
    gone = world.client.get("/" + first.removesuffix("/original")).json()
    assert (gone["state"], gone["kept_until"]) == ("rejected", None)
    assert put(world.client, field_bytes("4")).status_code == 201
    assert_refused(send(world, data=field_bytes("5")), 403, "QUOTA_STORED")


def test_kept_fields_give_way_too(worlds: Worlds) -> None:
    world = worlds(quota_fields=1)
    question(world, "1")
    assert put(world.client, field_bytes("2")).status_code == 201
    assert_refused(send(world, data=field_bytes("3")), 403, "QUOTA_STORED")


def test_the_same_question_is_asked_at_once_and_its_bytes_are_kept(world: World) -> None:
    place = question(world, "a")
    world.records.ahead_s = 7 * 3600
    assert Originals(world.records, world.blobs, world.settings).trim("anonymous") == 1
    assert world.blobs.blobs == {}
    answer = send(world)
    assert (answer.status_code, answer.json()["state"]) == (201, "rejected")
    assert set(world.blobs.blobs) == {place}
    assert change(world, description={"latent_index": 1}).status_code == 202


def test_a_rejected_field_that_is_sent_again_is_this_upload(world: World) -> None:
    send(world, None, BESIDE)
    imported(world, "LATENT_MISSING")
    answer = send(world, {"latent_index": 1})
    assert (answer.status_code, answer.json()["state"], answer.json()["settings"]) == (201, "validating", None)
    assert set(world.blobs.blobs) == {ORIGINAL}


def test_a_job_names_what_the_imports_of_its_fields_warned_of(world: World) -> None:
    job_id = world.submit()
    warned = {"scene": ["TRUNCATION_ASSUMED"]}
    record = world.job(job_id)
    assert world.client.get(f"/jobs/{job_id}").json()["warnings"] == {}
    world.records.update_job(job_id, record.attempt, inputs=record.inputs | {"warnings": warned})
    job = world.client.get(f"/jobs/{job_id}").json()
    assert (job["warnings"], job["inputs"]) == (warned, record.inputs)


# a file that may be one of several functions: the field's error has each of them, with a picture

SMOOTH, LINEAR = ({"hash": {"interpolation": kind}} for kind in ("smoothstep", "linear"))
ASKED = (Candidate("smooth", SMOOTH, b"\x89PNG smooth"), Candidate("linear", LINEAR), Candidate("c", {}, b"\x89PNG c"))
PICTURES = {f"{FOLDER}/candidates/{number}.png" for number in (1, 3)}
FIRST = f"{PLACE}/candidates/1.png"


def asked_about(world: World, asked: Sequence[Candidate] = ASKED, **said: Any) -> None:
    if not world.queue.imports:
        send(world, said or None)
    imported(world, "LAYOUT_AMBIGUOUS", asked)


def candidates(world: World, member: str, prefix: str = "") -> list[Any]:
    return [one[member] for one in world.client.get(prefix + PLACE).json()["error"]["candidates"]]


def test_each_candidate_has_what_to_say_and_its_picture_and_there_is_no_other(world: World) -> None:
    asked_about(world, label="chair")
    assert candidates(world, "name", "/v1") == ["smooth", "linear", "c"]
    assert candidates(world, "description", "/v1") == [SMOOTH, LINEAR, {}]
    pictures = candidates(world, "picture", "/v1")
    assert pictures == [f"/v1{FIRST}", None, f"/v1{PLACE}/candidates/3.png"]
    answer = world.client.get(pictures[2])
    assert (answer.status_code, answer.content, answer.headers["content-type"]) == (200, b"\x89PNG c", "image/png")
    assert world.client.head(pictures[0]).status_code == 200
    for number in ("0", "2", "4", "7", "01", "+1", "\u0661", "-1", "1.png", "..%2foriginal", "x"):
        assert world.client.get(f"{PLACE}/candidates/{number}.png").status_code == 404, number


def test_an_answer_makes_the_question_and_its_pictures_go(world: World) -> None:
    asked_about(world)
    assert set(world.blobs.blobs) == {ORIGINAL, *PICTURES}
    assert change(world, description=candidates(world, "description")[0]).status_code == 202
    assert_refused(world.client.get(FIRST), 404, "FIELD_VIEW_NOT_FOUND")
    asked_about(world, [Candidate("of two", {"sign": 1}), Candidate("the other", {"sign": -1}, b"\x89PNG -")])
    assert candidates(world, "name") == ["of two", "the other"], "another question takes the place of the first"
    assert set(world.blobs.blobs) == {ORIGINAL, f"{FOLDER}/candidates/2.png"}
    assert change(world, description={"sign": -1}).status_code == 202
    imported(world)
    assert [now(world)[name] for name in ("state", "description", "error")] == ["ready", SMOOTH | {"sign": -1}, None]
    assert set(world.blobs.blobs) == IMPORTED


def test_pictures_go_with_the_upload_and_with_the_field(world: World) -> None:
    """A rejection is remembered; its pictures are not."""
    asked_about(world)
    assert Originals(world.records, world.blobs, world.settings).free("anonymous")
    assert (world.blobs.blobs, candidates(world, "picture")) == ({}, [None] * 3)
    assert_refused(world.client.get(FIRST), 404, "FIELD_VIEW_NOT_FOUND")
    assert world.client.delete(PLACE).status_code == 204
    assert send(world).json()["state"] == "rejected"
    assert candidates(world, "picture") == [None] * 3
    assert change(world, description=SMOOTH).status_code == 202
    asked_about(world)
    assert world.client.delete(PLACE).status_code == 204
    assert world.blobs.blobs == {}


def test_without_a_kept_upload_there_are_no_pictures(worlds: Worlds) -> None:
    world = worlds(keep_originals="none")
    asked_about(world)
    assert (world.blobs.blobs, candidates(world, "picture")) == ({}, [None] * 3)
    assert candidates(world, "description") == [SMOOTH, LINEAR, {}]
