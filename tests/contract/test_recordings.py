"""Recordings over HTTP: how they come in, who sees them, what they may be used for, and what is refused."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from regnf_state.queue import Work
from tests.contract.conftest import GOOD, PNG
from tests.contract.test_bad_uploads import END, IN_PARTS, part
from tests.contract.world import ALICE, BOB, BOX, TOKENS, World, assert_refused, put, sha256
from tests.frame_forms import CAMERA, COLOR, DEPTH, MASK, archive, frame_parts, stored

FOLDER = archive(depth_png=DEPTH, camera_json=json.dumps(CAMERA).encode())
MASKED = {"mask": base64.b64encode(MASK).decode(), "label": "mug"}


def send(world: World, **changes: Any) -> Any:
    return world.client.post("/recordings", files=frame_parts(**changes))


def ready(world: World, answer: Any, path: Path | None = None, **about: Any) -> str:
    """What a worker leaves of a recording; its SHA-256."""
    assert answer.status_code == 201, answer.text
    name = str(answer.json()["sha256"])
    world.blobs.delete(f"fields/{name}/original")
    world.queue.remove(Work("import", name, 1).name)
    if path is not None:
        world.blobs.put(f"fields/{name}/field.safetensors", stored(path, **about))
    report = {"kind": "recording", "bounds": [[-1.0] * 3, [1.0] * 3]}
    world.records.update_field(name, attempt=1, state="ready", views="none", report=report)
    return name


def test_a_frame_in_parts_is_one_file_with_the_parts_as_they_came(world: World) -> None:
    answer = send(world)
    assert answer.status_code == 201, answer.text
    shown = answer.json()
    held = world.blobs.blobs[f"fields/{shown['sha256']}/original"]
    with zipfile.ZipFile(io.BytesIO(held)) as read:
        files = {name: read.read(name) for name in read.namelist()}
    assert files == {"depth.png": DEPTH, "color.png": COLOR, "camera.json": json.dumps(CAMERA).encode()}
    assert (sha256(held), len(held)) == (shown["sha256"], shown["bytes"])
    assert answer.headers["location"] == shown["links"]["self"] == f"/recordings/{shown['sha256']}"
    assert (send(world).status_code, send(world).json()["sha256"]) == (200, shown["sha256"])
    record = world.records.get_field(shown["sha256"])
    assert record is not None
    assert record.description == {"as": "recording"}
    assert world.queue.imports == [(shown["sha256"], 1)]


def test_files_are_taken_as_they_are_and_have_a_label(world: World) -> None:
    like_others = [archive(**{name: b"1"}) for name in ("depth_npy", "config_json", "a/data/0_png")]
    for data in (FOLDER, b"\x89MCAP0\r\n" + bytes(90), b"SQLite format 3\0" + bytes(90), *like_others):
        answer = world.client.post("/recordings?label=kitchen", content=data)
        assert (answer.status_code, answer.json()["sha256"]) == (201, sha256(data)), answer.text
        assert answer.json()["label"] == "kitchen"
    listed = world.client.get("/recordings?label=kitchen").json()["recordings"]
    assert len(listed) == 6
    assert world.client.get("/recordings?label=other").json()["recordings"] == []
    assert world.client.get("/fields").json()["fields"] == []


SAID = {"depth_unit": 0.0002, "layout": "tum", "camera_axes": "opengl", "intrinsics": {"K": [9, 9, 8, 6]}}


def described(**said: Any) -> dict[str, Any]:
    return {"description": (None, json.dumps(said).encode())}


def test_a_description_comes_with_a_file_its_pieces_or_a_frame(world: World) -> None:
    file = {"file": ("kitchen.zip", FOLDER)}
    for parts, status in ((frame_parts(), 201), (file, 201), ({"upload": (None, sha256(FOLDER))}, 200)):
        answer = world.client.post("/recordings", files=parts | described(**SAID))
        assert (answer.status_code, answer.json()["description"]) == (status, {"as": "recording", **SAID}), answer.text
    assert world.client.post("/recordings", content=FOLDER).status_code == 200  # nothing is said
    other = world.client.post("/recordings", files=file | described(depth_unit=0.001))
    assert_refused(other, 409, "FIELD_DESCRIPTION_DIFFERS")
    before = set(world.blobs.blobs)
    for said in ({"depth_unit": 2.0}, {"camera_axes": "unity"}, {"intrinsics": [9, 9, 8, 6]}, {"as": "field"}):
        answer = world.client.post("/recordings", files={"file": ("f", archive(a_bin=b"1"))} | described(**said))
        assert_refused(answer, 422, "INVALID_DESCRIPTION")
        assert set(world.blobs.blobs) == before, said


BAD_FRAMES: list[tuple[dict[str, Any], int, str]] = [
    ({"depth": None}, 400, "MALFORMED_MULTIPART"),
    ({"camera": None}, 400, "MALFORMED_MULTIPART"),
    ({"mask": MASK}, 400, "MALFORMED_MULTIPART"),
    ({"depth": b""}, 415, "RECORDING_NOT_RECOGNIZED"),
    ({"depth": b"\x89P"}, 415, "RECORDING_NOT_RECOGNIZED"),
    ({"depth": b"\xff\xd8\xff\xe0" + bytes(90)}, 415, "RECORDING_NOT_RECOGNIZED"),
    ({"color": b"GIF89a" + bytes(90)}, 415, "RECORDING_NOT_RECOGNIZED"),
    ({"depth": DEPTH + bytes(5000)}, 413, "UPLOAD_TOO_LARGE"),
    ({"camera": b" " * 70_000}, 413, "REQUEST_TOO_LARGE"),
    ({"camera": b"{"}, 400, "MALFORMED_JSON"),
    ({"camera": b"[1, 2]"}, 400, "MALFORMED_JSON"),
]
TWICE = b"".join(part("depth", DEPTH, file=True) for _ in "12") + part("camera", b"{}") + END
BAD_BODIES: list[tuple[bytes, dict[str, str], int, str]] = [
    (TWICE, IN_PARTS, 400, "MALFORMED_MULTIPART"),
    (TWICE[:-8], IN_PARTS, 400, "MALFORMED_MULTIPART"),
    (FOLDER, {"Content-Type": "text/plain"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
    (FOLDER, {"Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
    (FOLDER, {"Content-Length": str(len(FOLDER) + 9)}, 400, "UPLOAD_INCOMPLETE"),
    (FOLDER, {"Content-Digest": "sha-256=:AAAA:"}, 400, "INVALID_DIGEST"),
    (b"", {}, 400, "UPLOAD_INCOMPLETE"),
    (PNG, {}, 415, "RECORDING_NOT_RECOGNIZED"),
    (b"solid mesh\nfacet normal 0 0 1\n", {}, 415, "RECORDING_NOT_RECOGNIZED"),
    (archive(a_bin=bytes(5000)), {}, 413, "UPLOAD_TOO_LARGE"),
]


@pytest.mark.usefixtures("nothing_of_an_upload_stays")
def test_what_is_refused_leaves_nothing(world: World) -> None:
    for changes, status, reason in BAD_FRAMES:
        assert_refused(send(world, **changes), status, reason)
        assert world.blobs.blobs == {}, changes
    for content, headers, status, reason in BAD_BODIES:
        assert_refused(world.client.post("/recordings", content=content, headers=headers), status, reason)
        assert world.blobs.blobs == {}, headers


def test_a_recording_is_no_field_and_a_field_no_recording(world: World) -> None:
    field, recording = world.ready_field("room"), ready(world, send(world))
    for name in (field, recording):
        shown = [world.client.get(f"/{kind}/{name}").json() for kind in ("fields", "recordings")]
        assert shown[0] == shown[1]
        assert shown[0]["links"]["self"] == f"/{'fields' if name == field else 'recordings'}/{name}"
    assert_refused(world.client.patch(f"/fields/{recording}", json={"label": "x"}), 422, "RECORDING_UNSUITABLE")
    picture = world.client.get(f"/recordings/{field}/frames/0/color.png")
    assert_refused(picture, 404, "RECORDING_FRAME_NOT_FOUND")
    added = world.client.post(f"/recordings/{field}/frames", files=frame_parts(name=b"x"))
    assert_refused(added, 404, "NOT_FOUND")
    data = archive(depth_png=DEPTH)
    assert world.client.post("/recordings", content=data).status_code == 201
    for answer in (world.client.post("/fields", content=data), put(world.client, data)):
        assert "recording" in assert_refused(answer, 409, "FIELD_DESCRIPTION_DIFFERS")["hint"]
    taken = world.client.post("/recordings", content=GOOD)
    assert taken.status_code == 201  # a safetensors file may be a stored recording: its import will tell
    entry = world.client.post("/library", json={"name": "n", "field": recording})
    assert_refused(entry, 422, "RECORDING_UNSUITABLE")
    for changes in ({"object": recording}, {"object": field, "scene": field, "detection": MASKED}):
        reason = "IMAGE_DETECTION_WITHOUT_RECORDING" if "scene" in changes else "RECORDING_UNSUITABLE"
        answer = world.client.post("/register", json=world.valid_request() | changes)
        assert assert_refused(answer, 422, reason)["errors"]
    rendering = {"scene": recording, "edits": []}
    assert_refused(world.client.post("/render", json=rendering), 422, "RECORDING_UNSUITABLE")


def test_owners_do_not_see_each_others_recordings(worlds: Callable[..., World]) -> None:
    world = worlds(api_tokens=TOKENS)
    name = world.client.post("/recordings", content=FOLDER, headers=ALICE).json()["sha256"]
    assert world.client.get(f"/recordings/{name}", headers=ALICE).status_code == 200
    assert_refused(world.client.get(f"/recordings/{name}", headers=BOB), 404, "FIELD_NOT_FOUND")
    assert_refused(world.client.delete(f"/recordings/{name}", headers=BOB), 404, "FIELD_NOT_FOUND")
    assert world.client.get("/recordings", headers=BOB).json()["recordings"] == []
    assert world.client.post("/recordings", content=FOLDER, headers=BOB).status_code == 201


def test_quotas_count_recordings(worlds: Callable[..., World]) -> None:
    world = worlds(quota_fields=1, quota_stored_bytes=3000)
    assert_refused(world.client.post("/recordings", content=archive(a_bin=bytes(3000))), 403, "QUOTA_STORED")
    assert send(world).status_code == 201
    assert_refused(world.client.post("/recordings", content=FOLDER), 403, "QUOTA_STORED")
    assert world.blobs.blobs.keys() == {f"fields/{send(world).json()['sha256']}/original"}


def test_frames_have_pictures(world: World, tmp_path: Path) -> None:
    name = ready(world, send(world), tmp_path / "field.safetensors")
    address = world.client.get(f"/recordings/{name}").json()["links"]["picture"]
    for frame in ("a", "0", "b"):
        answer = world.client.get(f"/recordings/{name}/frames/{frame}/color.png")
        with Image.open(io.BytesIO(answer.content)) as image:
            assert (image.size, image.mode, image.getpixel((3, 3))) == ((16, 12), "RGB", (90, 90, 90))
    etag = {"If-None-Match": answer.headers["etag"]}
    assert world.client.get(address, headers=etag).status_code == 304
    for frame in ("c", "7", "..%2Fa%2Fb", "99999999999", "%E2%80%AE"):
        answer = world.client.get(f"/recordings/{name}/frames/{frame}/color.png")
        assert_refused(answer, 404, "RECORDING_FRAME_NOT_FOUND")
    plain = ready(world, send(world, color=None), tmp_path / "plain.safetensors", colored=False)
    answer = world.client.get(f"/recordings/{plain}/frames/a/color.png")
    with Image.open(io.BytesIO(answer.content)) as image:
        assert (image.size, image.mode, image.getpixel((15, 0))) == ((16, 12), "L", 255)
        assert image.getpixel((0, 0)) < 200
    unread = world.client.post("/recordings", content=FOLDER).json()["sha256"]
    picture = world.client.get(f"/recordings/{unread}/frames/0/color.png")
    assert_refused(picture, 404, "RECORDING_FRAME_NOT_FOUND")


def test_a_frame_is_added_as_another_recording(world: World) -> None:
    first = ready(world, send(world))
    address = f"/recordings/{first}/frames"
    answer = world.client.post(address, files=frame_parts(name=b"left"))
    assert answer.status_code == 201, answer.text
    second = answer.json()
    assert second["description"] == {"as": "recording", "after": first, "frame": "left"}
    assert second["sha256"] != first
    assert world.client.post(address, files=frame_parts(name=b"left")).json()["sha256"] == second["sha256"]
    assert world.client.post(address, files=frame_parts(name=b"right")).json()["sha256"] != second["sha256"]
    for name, status, reason in (
        (None, 400, "MALFORMED_MULTIPART"),
        (b"a/b", 422, "INVALID_REQUEST"),
        (b"n" * 401, 413, "REQUEST_TOO_LARGE"),
    ):
        assert_refused(world.client.post(address, files=frame_parts(name=name)), status, reason)
    assert_refused(world.client.post(address, content=FOLDER), 415, "UNSUPPORTED_MEDIA_TYPE")
    later = f"/recordings/{second['sha256']}/frames"
    assert_refused(world.client.post(later, files=frame_parts(name=b"x")), 409, "FIELD_VALIDATING")
    nobody = world.client.post(f"/recordings/{'0' * 64}/frames", files=frame_parts(name=b"x"))
    assert_refused(nobody, 404, "FIELD_NOT_FOUND")


def test_a_recording_stays_while_a_job_needs_it(world: World) -> None:
    scene = ready(world, send(world))
    job = world.client.post("/register", json=world.valid_request() | {"scene": scene, "detection": MASKED})
    assert job.status_code == 202, job.text
    assert_refused(world.client.delete(f"/recordings/{scene}"), 409, "FIELD_IN_USE")
    assert world.client.post(f"/jobs/{job.json()['id']}/cancel").status_code == 202
    assert world.client.delete(f"/recordings/{scene}").status_code == 204
    assert_refused(world.client.get(f"/recordings/{scene}"), 404, "FIELD_NOT_FOUND")


# what they are for


def ask(world: World, scene: str, detection: Any, **more: Any) -> Any:
    return world.client.post("/register", json=world.valid_request() | {"scene": scene, "detection": detection} | more)


def test_a_detection_in_images_is_kept_as_it_is_and_told_without_masks(world: World) -> None:
    scene = ready(world, send(world))
    several = [{"frame": "a", **MASKED}, {"frame": 1, "box_2d": [1, 2, 9, 8]}, {"frame": "b", "point_2d": [3, 4]}]
    runs = {"mask": {"size": [12, 16], "counts": [96, 96]}}
    jobs = [ask(world, scene, one) for one in (several, MASKED, runs, BOX)]
    assert [job.status_code for job in jobs] == [202] * 4, [job.text for job in jobs]
    request = world.job(jobs[0].json()["id"]).request
    assert [one.get("mask") for one in request["detection"]] == [MASKED["mask"], None, None]
    assert request["detection"][1]["box_2d"] == [1.0, 2.0, 9.0, 8.0]
    shown = jobs[0].json()["inputs"]["detection"]
    assert [one["frame"] for one in shown] == ["a", 1, "b"]
    assert shown[0]["mask"] is True
    renamed = ask(world, scene, MASKED | {"label": "cup", "score": 0.5})
    assert renamed.json()["id"] == jobs[1].json()["id"] != jobs[2].json()["id"]
    lines = [json.dumps(world.valid_request() | {"scene": scene, "detection": one}) for one in (MASKED, several)]
    batch = world.client.post("/batches", content="\n".join(lines), headers={"Content-Type": "application/x-ndjson"})
    assert (batch.status_code, batch.json()["pairs"], batch.json()["counts"]["refused"]) == (202, 2, 0), batch.text


BAD_DETECTIONS: list[Any] = [
    {"mask": "mask.png"},
    {"mask": "*" * 90},
    {"mask": base64.b64encode(COLOR[1:]).decode()},
    {"mask": None},
    {"box_2d": [9, 2, 1, 8]},
    {"box_2d": [1, 2, 3]},
    {"point_2d": [1, "2"]},
    {"point_2d": [1, 2], "frame": None},
    {"point_2d": [1, 2], "frame": "f" * 201},
    [{"point_2d": [1, 2]}] * 33,
    [{"point_2d": [1, 2]}, BOX],
]


def test_detections_that_are_none_are_refused_with_a_reason(world: World) -> None:
    scene = ready(world, send(world))
    for one in BAD_DETECTIONS:
        problem = assert_refused(ask(world, scene, one), 422, "INVALID_DETECTION")
        assert problem["errors"][0]["pointer"].startswith("/detection"), one
    many = ask(world, scene, [{"point_2d": [1, 2]}] * 10_000)
    assert_refused(many, 413, "REQUEST_TOO_LARGE")
    far = {"min": [50, 50, 50], "max": [51, 51, 51]}
    assert_refused(ask(world, scene, far), 422, "DETECTION_OUTSIDE_SCENE")


def one_shot(world: World, request: dict[str, Any], **changes: Any) -> Any:
    parts = frame_parts(**changes, request=json.dumps(request).encode())
    return world.client.post("/register", files=parts)


def test_one_body_has_the_frame_and_names_the_object(world: World) -> None:
    object_ = world.valid_request()["object"]
    answer = one_shot(world, {"object": object_}, mask=MASK)
    assert answer.status_code == 202, answer.text
    request = world.job(answer.json()["id"]).request
    assert request["scene"] == send(world).json()["sha256"]
    assert request["detection"] == [{"frame": 0, "mask": MASKED["mask"]}]
    assert one_shot(world, {"object": object_}, mask=MASK).json()["id"] == answer.json()["id"]
    named = world.client.post("/library", json={"name": "mug", "field": object_})
    assert named.status_code == 201
    again = one_shot(world, {"object": {"library": "mug"}, "detection": {"mask": MASKED["mask"]}})
    assert again.json()["id"] == answer.json()["id"]
    several = one_shot(world, {"candidates": {"library": {}}, "detection": {"point_2d": [3, 3]}})
    assert several.status_code == 202, several.text
    with_file = frame_parts(mask=MASK, request=b"{}") | {"object": ("o", GOOD)}
    assert world.client.post("/register", files=with_file).status_code == 202


@pytest.mark.usefixtures("nothing_of_a_request_stays")
def test_one_body_is_refused_whole(world: World) -> None:
    object_ = world.valid_request()["object"]
    held = {"object": object_}
    before = set(world.blobs.blobs)
    cases: list[tuple[dict[str, Any], dict[str, Any], int, str]] = [
        (held, {}, 422, "INVALID_DETECTION"),
        (held | {"detection": {"point_2d": [1, 1]}}, {"mask": MASK}, 422, "INVALID_DETECTION"),
        (held, {"mask": b"no PNG"}, 422, "INVALID_DETECTION"),
        ({}, {"mask": MASK}, 400, "MALFORMED_MULTIPART"),
        (held, {"mask": MASK, "object": GOOD}, 400, "MALFORMED_MULTIPART"),
        (held, {"mask": MASK, "scene": GOOD}, 400, "MALFORMED_MULTIPART"),
        (held, {"mask": MASK, "camera": None}, 400, "MALFORMED_MULTIPART"),
        (held, {"depth": None, "camera": None, "color": None, "mask": MASK, "scene": GOOD}, 400, "MALFORMED_MULTIPART"),
        (held, {"mask": MASK, "object_settings": b"a: 1"}, 400, "MALFORMED_MULTIPART"),
        ({"object": "0" * 64}, {"mask": MASK}, 404, "FIELD_NOT_FOUND"),
        ({"object": {"library": "none"}}, {"mask": MASK}, 404, "LIBRARY_ENTRY_NOT_FOUND"),
        (held | {"candidates": [object_]}, {"mask": MASK}, 422, "INVALID_REQUEST"),
        (held | {"scene": object_}, {"mask": MASK}, 422, "INVALID_REQUEST"),
        (held, {"mask": MASK, "depth": b"x" * 90}, 415, "RECORDING_NOT_RECOGNIZED"),
    ]
    for request, changes, status, reason in cases:
        assert_refused(one_shot(world, request, **changes), status, reason)
        assert set(world.blobs.blobs) == before, (request, changes)
    alone = {"scene": ("s", GOOD), "object": ("o", archive(a_bin=b"1"))}
    body = alone | {"request": (None, json.dumps({"detection": {"point_2d": [1, 1]}}).encode())}
    assert_refused(world.client.post("/register", files=body), 422, "IMAGE_DETECTION_WITHOUT_RECORDING")
    assert set(world.blobs.blobs) == before


def test_a_large_recording_comes_in_pieces(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in (("uploads._BLOCK_BYTES", 600), ("uploads.HEAD_BYTES", 500), ("piecewise.HEAD_BYTES", 500)):
        monkeypatch.setattr(f"regnf_service.fields.{name}", size)  # a piece is written in several blocks
    data = b"\x89MCAP0\r\n" + bytes(3000)
    name = sha256(data)
    for first, last in ((0, 1999), (2000, len(data) - 1)):
        span = {"Content-Range": f"bytes {first}-{last}/{len(data)}", "Upload-Complete": "?0"}
        answer = world.client.put(f"/fields/{name}", content=data[first : last + 1], headers=span)
        assert answer.status_code == 202, answer.text
    named = {"upload": (None, name)}
    both = world.client.post("/recordings", files=frame_parts() | named)
    assert_refused(both, 400, "MALFORMED_MULTIPART")
    answer = world.client.post("/recordings", files=named)
    assert (answer.status_code, answer.json()["sha256"]) == (201, name), answer.text
    assert world.client.post("/recordings", files=named).status_code == 200
    assert world.blobs.blobs.keys() == {f"fields/{name}/original"}
    assert_refused(world.client.post("/recordings", files={"upload": (None, "x")}), 400, "INVALID_DIGEST")
    assert_refused(world.client.post("/recordings", files={"upload": (None, "0" * 64)}), 409, "UPLOAD_NOT_FINISHED")
