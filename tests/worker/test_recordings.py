"""Recordings in the worker: their import, frames that are added, and registrations in them."""

from __future__ import annotations

import base64
import gzip
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from regnf_core.detections.images import read_image_detections
from regnf_core.errors import RegnfError
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.options import RegistrationOptions
from regnf_data.recordings.stored import frame_of_arrays, read_stored, recording_of_frames, write_recording
from regnf_state.records import FieldRecord
from regnf_worker.engine import Engine, core_importer
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from regnf_worker.recorded import place_of
from tests.frame_forms import CAMERA, COLOR, DEPTH, SIZE, archive, png
from tests.frames import K, Shot, error_m, shots, write_model
from tests.requests import registration_request
from tests.worker.doubles import SHA

LATER = "b" * 64


def imported(context: Context, data: bytes, reference: str = SHA, **said: Any) -> FieldRecord:
    """What the import has left of an upload."""
    now = context.records.now()
    description = {"as": "recording", **said}
    context.records.create_field(FieldRecord(reference, "validating", len(data), now, now, description=description))
    context.blobs.put(f"fields/{reference}/original", data)
    record = context.records.get_field(reference)
    assert record is not None
    run_import_attempt(context, reference, record.attempt, "w", core_importer(ImportLimits()))
    record = context.records.get_field(reference)
    assert record is not None
    return record


def frame(depth: bytes = DEPTH, **camera: Any) -> bytes:
    return archive(depth_png=depth, color_png=COLOR, camera_json=json.dumps(CAMERA | camera).encode())


def test_a_recording_is_imported_as_a_field_is_and_gets_frames(context: Context) -> None:
    record = imported(context, frame())
    assert (record.state, record.views, record.report["kind"]) == ("ready", "none", "recording"), record.error
    assert list(context.blobs.list("")) == [f"fields/{SHA}/{name}" for name in ("field.safetensors", "report.json")]
    sizes = {entry.key: entry.bytes for entry in context.blobs.entries("")}
    assert record.kept_bytes == sizes[f"fields/{SHA}/field.safetensors"]
    assert context.records.undrawn_fields() == []
    moved = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    far = frame(png(np.full(SIZE, 9000, np.uint16)), T_world_camera=moved)
    more = imported(context, far, LATER, after=SHA, frame="left")
    assert (more.state, more.report["frames"]) == ("ready", ["depth", "left"]), more.error
    assert more.report["bounds"][1][0] > 5.0
    with context.blobs.local_copy(f"fields/{LATER}/field.safetensors") as path:
        held = read_stored(path)
        assert [one.name for one in held.frames] == ["depth", "left"]
        assert held.frames[0].read().depth.max() == pytest.approx(0.8, abs=1e-3)
        assert held.frames[1].read().depth.max() == pytest.approx(9.0, abs=1e-3)
        assert held.frames[1].T_world_camera.tolist() == moved


def test_what_is_said_of_a_recording_goes_before_its_files(context: Context) -> None:
    said = {"depth_unit": 0.002, "layout": "frame", "camera_axes": "opengl", "intrinsics": {"K": [16, 16, 8, 6]}}
    record = imported(context, frame(), **said)
    assert record.state == "ready", record.error
    with context.blobs.local_copy(f"fields/{SHA}/field.safetensors") as path:
        (held,) = read_stored(path).frames
        assert held.read().depth.max() == pytest.approx(1.6, abs=1e-3)
        assert (held.camera.K[0, 0], held.T_world_camera[1, 1]) == (16.0, -1.0)


@pytest.mark.parametrize(
    ("said", "data", "reason"),
    [
        ({"intrinsics": {"nothing": 1}}, frame(), "DATASET_INTRINSICS_INVALID"),
        ({"layout": "none such"}, frame(), "DATASET_NOT_RECOGNIZED"),
        ({"after": SHA, "frame": "depth"}, frame(), "DATASET_FRAMES_INVALID"),
        ({"after": SHA, "frame": "left"}, frame(png(np.full((24, 32), 700, np.uint16))), "DATASET_SIZES_DIFFER"),
        ({"after": "c" * 64, "frame": "left"}, frame(), "FIELD_NOT_FOUND"),
        ({}, frame(png(np.zeros(SIZE, np.uint16))), "DATASET_DEPTH_MISSING"),
        ({}, frame(cx=900.0), "DATASET_INTRINSICS_INVALID"),
        ({}, frame(depth_unit=1e9), "DATASET_INTRINSICS_INVALID"),
        ({}, frame(depth_unit="feet"), "DATASET_INTRINSICS_INVALID"),
        ({}, frame(T_world_camera=np.diag([1, 1, -1, 1]).tolist()), "DATASET_POSE_NOT_RIGID"),
        ({}, frame()[:300], "FILE_TRUNCATED"),
        ({}, archive(notes_txt=b"nothing"), "DATASET_NOT_RECOGNIZED"),
        ({}, gzip.compress(bytes(range(256)) * 20), "ARCHIVE_MALFORMED"),
        ({}, b"SQLite format 3\0" + bytes(5000), "DATASET_BAG_INVALID"),
    ],
)
def test_a_recording_that_is_none_leaves_nothing(
    context: Context, said: dict[str, Any], data: bytes, reason: str
) -> None:
    if said.get("after") == SHA:
        assert imported(context, frame()).state == "ready"
    record = imported(context, data, LATER, **said)
    assert (record.state, (record.error or {}).get("reason")) == ("rejected", reason)
    assert list(context.blobs.list(f"fields/{LATER}")) == []


# registrations


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stored recording of the thing on the table, from two sides."""
    path = tmp_path_factory.mktemp("recording") / "field.safetensors"
    frames = [
        frame_of_arrays(one.depth, K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], one.color, None, one.T_world_camera, name)
        for one, name in zip(shots(2), "ab", strict=True)
    ]
    write_recording(recording_of_frames(frames), range(2), path)
    return path


def mask_of(shot: Shot) -> str:
    return base64.b64encode(png(shot.mask)).decode()


def test_a_thing_in_an_image_is_registered_where_the_camera_saw_it(scene: Path, tmp_path: Path) -> None:
    import_field(write_model(tmp_path), tmp_path / "object", {"as": "object"})
    engine, options = Engine("cpu"), RegistrationOptions()
    object_ = tmp_path / "object" / "field.safetensors"
    engine.make_model(object_, options, tmp_path / "model.safetensors")
    model = engine.read_model(tmp_path / "model.safetensors")
    seen = read_image_detections([{"frame": "b", "mask": mask_of(shots(2)[1])}])
    request = registration_request("a" * 64, "b" * 64, detection=seen, options=options)
    made = engine.register(scene, object_, model, request, lambda *_: None, tmp_path, {})
    told = json.loads((tmp_path / "result.json").read_text())
    assert (told["verdict"], told["camera"]["frame"], told["camera"]["object_unit_m"]) == ("registered", "b", 0.001)
    assert any("unit is" in warning and "mm" in warning for warning in told["fields"]["scene"]["warnings"]), told[
        "fields"
    ]
    truth = shots(2)[1].T_camera_object
    assert error_m(told["camera"]["T_camera_object"]["matrix"], truth) < 0.01
    assert "overlay.png" in made.to_come
    assert {"overlay.png", "aligned.ply"} <= set(made.finish())
    assert (tmp_path / "overlay.png").read_bytes().startswith(b"\x89PNG")


def empty() -> str:
    return base64.b64encode(png(np.zeros(shots(1)[0].mask.shape, np.bool_))).decode()


@pytest.mark.parametrize(
    ("detection", "reason", "told"),
    [
        (
            {"mask": base64.b64encode(png(np.eye(9, 16) > 0)).decode()},
            "INVALID_DETECTION",
            "the mask has 16 x 9 pixels",
        ),
        ({"mask": empty(), "frame": "b"}, "INVALID_DETECTION", "frame b: the mask is empty"),
        ({"mask": {"size": [180, 240], "counts": [100, 5]}}, "INVALID_DETECTION", "runs have 105 pixels"),
        ({"mask": {"size": [180, 240], "counts": "QQQ"}}, "INVALID_DETECTION", "run-length encoding"),
        ({"mask": {"counts": [1]}}, "INVALID_DETECTION", "run-length encoding cannot be read"),
        ({"point_2d": [500, 3]}, "INVALID_DETECTION", "outside the image"),
        ({"box_2d": [500, 3, 600, 80]}, "INVALID_DETECTION", "outside the image"),
        ({"point_2d": [5, 3], "frame": "c"}, "DATASET_FRAMES_INVALID", "no frame 'c'"),
        ({"box_2d": [0, 0, 3, 3]}, "DETECTION_WITHOUT_DEPTH", "frame a"),
    ],
)
def test_a_detection_that_does_not_fit_says_why(scene: Path, detection: Any, reason: str, told: str) -> None:
    request = registration_request("a" * 64, None, detection=read_image_detections([{"frame": "a"} | detection]))
    with pytest.raises(RegnfError, match=told) as caught:
        place_of(scene, request, None, "cpu")
    assert caught.value.reason == reason


def test_a_bomb_of_a_mask_is_not_decoded(scene: Path) -> None:
    data = png(np.zeros((4, 4), np.bool_))
    header = data[12:16] + (60_000).to_bytes(4, "big") * 2 + data[24:29]
    whole = data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:]
    bomb = base64.b64encode(whole).decode()
    request = registration_request("a" * 64, None, detection=read_image_detections([{"mask": bomb}]))
    with pytest.raises(RegnfError) as caught:
        place_of(scene, request, None, "cpu")
    assert caught.value.reason == "INVALID_DETECTION"
