"""What comes beside a field's file, and what is said of it afterwards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from redis import Redis

from regnf_core.errors import FieldFormatError
from regnf_state.queue import Work
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from tests.contract.test_registrations import one_shot
from tests.contract.world import BOX, World, assert_refused, field_bytes, make_world, sha256
from tests.worker.tiny_engine import tiny_importer

A = field_bytes("a")
PLACE = f"/fields/{sha256(A)}"
ORIGINAL = f"fields/{sha256(A)}/original"
CONFIG = b"method: neus\n"
SETTINGS = f"fields/{sha256(A)}/settings-{sha256(CONFIG)}"
MESH = b"ply\nformat ascii 1.0\n".ljust(600)


def send(world: World, said: Any = None, settings: tuple[str, bytes] | None = None, data: bytes = A) -> httpx.Response:
    files: dict[str, Any] = {"file": ("a.ckpt", data)}
    if said is not None:
        files["description"] = (None, json.dumps(said), "application/json")
    if settings is not None:
        files["settings"] = settings
    return world.client.post("/fields", files=files)


def imported(world: World, reason: str | None = None) -> None:
    """The import that waits is done: well, or refused for ``reason``."""

    def importer(*given: Any) -> dict[str, Any]:
        if reason is not None:
            raise FieldFormatError("which one is it?", reason=reason)
        return tiny_importer(*given)

    reference, attempt = world.queue.imports[-1]
    world.queue.remove(Work("import", reference, attempt).name)
    context = Context(world.settings, world.records, world.blobs, world.queue)
    run_import_attempt(context, reference, attempt, "w", importer)


def change(world: World, **values: Any) -> httpx.Response:
    return world.client.patch(PLACE, json=values)


# settings beside the file


def test_settings_are_stored_beside_the_file(world: World) -> None:
    answer = send(world, {"sign": -1}, ("runs/1/config.yml", CONFIG))
    assert answer.status_code == 201, answer.text
    document = answer.json()
    assert (document["description"], document["bytes"]) == ({"sign": -1}, len(A))
    assert document["settings"] == {"name": "config.yml", "sha256": sha256(CONFIG), "bytes": len(CONFIG)}
    assert world.blobs.blobs == {ORIGINAL: A, SETTINGS: CONFIG}
    imported(world)
    assert set(world.blobs.blobs) == {f"fields/{sha256(A)}/{name}" for name in ("field.safetensors", "report.json")}
    assert world.client.get(PLACE).json()["settings"]["name"] == "config.yml"


def test_cameras_are_stored_beside_the_file_and_make_another_function_of_it(world: World) -> None:
    poses = b"0 0 0 0 0 0 0 1\n"
    said = json.dumps({"cameras": {"intrinsics": [1, 1, 1, 1]}})
    files = {"file": ("a.ckpt", A), "cameras": ("walk/poses.txt", poses), "settings": ("config.yml", CONFIG)}
    answer = world.client.post("/fields", files={**files, "description": (None, said, "application/json")})
    assert answer.status_code == 201, answer.text
    document = answer.json()
    assert document["cameras"] == {"name": "poses.txt", "sha256": sha256(poses), "bytes": len(poses)}
    assert document["description"] == {"cameras": {"intrinsics": [1.0, 1.0, 1.0, 1.0]}}
    assert world.blobs.blobs[f"fields/{sha256(A)}/settings-{sha256(poses)}"] == poses
    assert send(world, json.loads(said), ("config.yml", CONFIG)).json()["reason"] == "FIELD_DESCRIPTION_DIFFERS"
    imported(world)
    assert set(world.blobs.blobs) == {f"fields/{sha256(A)}/{name}" for name in ("field.safetensors", "report.json")}


@pytest.mark.parametrize(
    ("filename", "name"),
    [
        ("C:\\runs\\config.yml", "config.yml"),
        ("../../../etc/passwd", "passwd"),
        ("..", "settings"),
        (".hidden.yml", "hidden.yml"),
        ("a b\u00e4.yml", "a_b__.yml"),
        ("x" * 300 + ".yml", ("x" * 300 + ".yml")[-100:]),
    ],
)
def test_a_name_of_settings_is_a_plain_name(world: World, filename: str, name: str) -> None:
    assert send(world, None, (filename, CONFIG)).json()["settings"]["name"] == name


def test_the_same_bytes_with_other_settings_are_another_function(world: World) -> None:
    assert send(world, None, ("config.yml", CONFIG)).status_code == 201
    assert send(world, None, ("renamed.yml", CONFIG)).status_code == 200
    assert send(world, {"label": "room"}, ("config.yml", CONFIG)).json()["label"] == "room"
    assert_refused(send(world, None, ("config.yml", b"other")), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert_refused(send(world, {"sign": -1}, ("config.yml", CONFIG)), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert_refused(send(world, {"sign": -1}), 409, "FIELD_DESCRIPTION_DIFFERS")
    assert world.client.put(PLACE, content=A).status_code == 200
    assert world.blobs.blobs == {ORIGINAL: A, SETTINGS: CONFIG}


def test_settings_have_their_limit_and_are_not_empty(world: World) -> None:
    assert_refused(send(world, None, ("config.yml", b"x" * 5000)), 413, "UPLOAD_TOO_LARGE")
    assert_refused(send(world, None, ("config.yml", b"")), 400, "UPLOAD_EMPTY")
    assert world.blobs.blobs == {}


def test_settings_count_towards_the_quota(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, quota_stored_bytes=1000)
    assert_refused(send(world, None, ("config.yml", b"x" * 500)), 403, "QUOTA_STORED_BYTES")
    assert send(world, None, ("config.yml", b"x" * 300)).status_code == 201
    assert world.records.stored("anonymous") == (1, 900)


def test_one_shot_takes_settings_and_descriptions_of_both(world: World) -> None:
    scene, object_ = field_bytes("one"), field_bytes("two")
    files = one_shot(scene, object_, {"detection": BOX}) | {
        "scene_settings": ("config.yml", CONFIG),
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
    question = {"detection": BOX}
    other = MESH + b"."
    assert send(world, data=other).status_code == 201
    assert world.client.post("/register", files=one_shot(MESH, other, question)).status_code == 202
    descriptions = [world.client.get(f"/fields/{sha256(data)}").json()["description"] for data in (MESH, other)]
    assert descriptions == [{"as": "scene"}, {}]
    assert send(world, {"label": "room"}, data=MESH).status_code == 200
    assert_refused(send(world, {"as": "object"}, data=MESH), 409, "FIELD_DESCRIPTION_DIFFERS")


# what is said afterwards


def test_a_question_is_answered_without_a_second_upload(world: World) -> None:
    send(world, {"level_mask": 4, "hash": {"levels": 16}}, ("config.yml", CONFIG))
    imported(world, "LATENT_MISSING")
    document = world.client.get(PLACE).json()
    assert (document["state"], document["error"]["reason"]) == ("rejected", "LATENT_MISSING")
    assert document["kept_until"] > document["updated_at"]
    assert "original_until" not in document["error"]
    answer = change(world, description={"latent_index": 3, "level_mask": None, "hash": {"base_resolution": 16}})
    assert answer.status_code == 202, answer.text
    told = answer.json()
    assert (told["state"], told["error"], told["kept_until"]) == ("validating", None, None)
    assert told["description"] == {"latent_index": 3, "hash": {"levels": 16, "base_resolution": 16}}
    assert world.queue.imports == [(sha256(A), 2)]
    imported(world)
    assert world.client.get(PLACE).json()["state"] == "ready"
    assert "original" not in str(set(world.blobs.blobs))
    assert_refused(change(world, description={"latent_index": 4}), 409, "FIELD_BYTES_GONE")


def test_a_label_is_changed_in_place(world: World) -> None:
    world.ready_field("a")
    assert change(world, label="chair").json()["label"] == "chair"
    assert change(world, description={}).json()["label"] == "chair"
    assert change(world, description={"label": "room"}).json()["label"] == "room"
    answer = change(world, label=None)
    assert (answer.status_code, answer.json()["label"], answer.json()["state"]) == (200, None, "ready")
    assert world.queue.imports == []


def test_a_ready_field_is_imported_anew_where_its_bytes_are_kept(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, keep_originals="all")
    send(world, {"sign": -1})
    imported(world)
    document = world.client.get(PLACE).json()
    assert (document["state"], document["kept_until"] is not None) == ("ready", True)
    assert "original_until" not in document["report"]
    assert change(world, description=None).status_code == 202
    imported(world)
    assert world.client.get(PLACE).json()["description"] == {}
    assert world.client.delete(PLACE).status_code == 204
    assert world.blobs.blobs == {}
    assert world.records.stored("anonymous") == (0, 0)


def test_what_an_active_job_uses_keeps_its_function(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, keep_originals="all")
    send(world)
    imported(world)
    job_id = world.submit(object=sha256(A))
    assert_refused(change(world, description={"sign": -1}), 409, "FIELD_IN_USE")
    world.succeed(job_id)
    assert change(world, description={"sign": -1}).status_code == 202
    imported(world)
    assert world.submit(object=sha256(A)) != job_id, "the result of another function is no answer"


def test_a_job_that_comes_in_between_keeps_the_function(
    tmp_path: Path, any_redis: Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = make_world(tmp_path, any_redis, keep_originals="all")
    send(world)
    imported(world)
    before = world.client.get(PLACE).json()
    answers = iter([[], ["job"]])
    monkeypatch.setattr(world.records, "jobs_using_field", lambda _: iter(next(answers)))
    assert_refused(change(world, description={"sign": -1}), 409, "FIELD_IN_USE")
    after = world.client.get(PLACE).json()
    assert {name: after[name] for name in ("state", "description", "report", "kept_until")} == {
        name: before[name] for name in ("state", "description", "report", "kept_until")
    }
    assert world.queue.imports == []


@pytest.mark.parametrize(
    ("body", "status", "reason"),
    [
        ({"description": {"sign": 3}}, 422, "INVALID_DESCRIPTION"),
        ({"description": {"sing": -1}}, 422, "INVALID_DESCRIPTION"),
        ({"description": {"settings": {"name": "x"}}}, 422, "INVALID_DESCRIPTION"),
        ({"description": []}, 422, "INVALID_REQUEST"),
        ({"sign": -1}, 422, "INVALID_REQUEST"),
        ({"label": ""}, 422, "INVALID_REQUEST"),
        ([], 422, "INVALID_REQUEST"),
        ({"description": {"sign": -1}}, 409, "FIELD_VALIDATING"),
    ],
)
def test_changes_that_are_refused(world: World, body: Any, status: int, reason: str) -> None:
    send(world)
    problem = assert_refused(world.client.patch(PLACE, json=body), status, reason)
    if reason == "INVALID_DESCRIPTION":
        assert problem["errors"][0]["pointer"].startswith("/description/s")
    assert world.client.get(PLACE).json()["description"] == {}


def test_a_change_is_json(world: World) -> None:
    send(world)
    answer = world.client.patch(PLACE, content=b"sign=-1", headers={"Content-Type": "text/plain"})
    assert_refused(answer, 415, "UNSUPPORTED_MEDIA_TYPE")
    headers = {"Content-Type": "application/merge-patch+json"}
    assert world.client.patch(PLACE, content=b'{"label": "x"}', headers=headers).json()["label"] == "x"


# room


def question(world: World, name: str) -> str:
    """An upload that was rejected with a question; its bytes are kept."""
    send(world, data=field_bytes(name))
    imported(world, "LATENT_MISSING")
    return f"fields/{sha256(field_bytes(name))}/original"


def test_kept_bytes_count_and_give_way(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, quota_stored_bytes=1300)
    first, second = question(world, "1"), question(world, "2")
    assert world.records.stored("anonymous") == (2, 1200)
    assert send(world, data=field_bytes("3")).status_code == 201
    assert set(world.blobs.blobs) == {second, f"fields/{sha256(field_bytes('3'))}/original"}
    gone = world.client.get("/" + first.removesuffix("/original")).json()
    assert (gone["state"], gone["kept_until"]) == ("rejected", None)
    assert world.client.put(f"/fields/{sha256(field_bytes('4'))}", content=field_bytes("4")).status_code == 201
    assert_refused(send(world, data=field_bytes("5")), 403, "QUOTA_STORED_BYTES")


def test_kept_fields_give_way_too(tmp_path: Path, any_redis: Redis) -> None:
    world = make_world(tmp_path, any_redis, quota_fields=1)
    question(world, "1")
    assert world.client.put(f"/fields/{sha256(field_bytes('2'))}", content=field_bytes("2")).status_code == 201
    assert_refused(send(world, data=field_bytes("3")), 403, "QUOTA_FIELDS")


def test_the_same_question_is_asked_at_once_and_its_bytes_are_kept(world: World) -> None:
    place = question(world, "a")
    world.records.ahead_s = 7 * 3600
    from regnf_state.room import Originals

    assert Originals(world.records, world.blobs, world.settings).trim("anonymous") == 1
    assert world.blobs.blobs == {}
    answer = send(world)
    assert (answer.status_code, answer.json()["state"]) == (201, "rejected")
    assert set(world.blobs.blobs) == {place}
    assert change(world, description={"latent_index": 1}).status_code == 202


def test_a_rejected_field_that_is_sent_again_is_this_upload(world: World) -> None:
    send(world, None, ("config.yml", CONFIG))
    imported(world, "LATENT_MISSING")
    answer = send(world, {"latent_index": 1})
    assert (answer.status_code, answer.json()["state"], answer.json()["settings"]) == (201, "validating", None)
    assert set(world.blobs.blobs) == {ORIGINAL}


# warnings


def test_a_job_names_what_the_imports_of_its_fields_warned_of(world: World) -> None:
    job_id = world.submit()
    warned = {"scene": ["TRUNCATION_ASSUMED"]}
    record = world.records.get_job(job_id)
    assert record is not None
    assert world.client.get(f"/jobs/{job_id}").json()["warnings"] == {}
    world.records.update_job(job_id, record.attempt, inputs=record.inputs | {"warnings": warned})
    job = world.client.get(f"/jobs/{job_id}").json()
    assert job["warnings"] == warned
    assert job["inputs"] == record.inputs
