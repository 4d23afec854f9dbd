"""Detections of one thing in several frames, and which frames are read for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from regnf_core.detections.images import ImageDetection
from regnf_core.errors import InvalidDetectionError
from regnf_core.options import RegistrationOptions
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.recording import Recording, StoredFrame
from regnf_fit.images.recorded_scene import recorded_scene
from tests.data.recordings.test_detection import CAMERA, CENTER, RADIUS
from tests.fit.test_aligning import REGION, about, depth_from, turned

BOUNDS = np.array([[-RADIUS] * 3, [RADIUS] * 3])
METERS = RegistrationOptions.from_dict({"robust": {"object_unit": "m"}})


def recording_of_turns(
    angles: list[float], read: list[str] | None = None, axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> tuple[Recording, list[Any]]:
    """Frames from around the ball, and the mask of the ball in each."""
    frames, masks = [], []
    for number, angle in enumerate(angles):
        T = about(CENTER, turned(axis, angle), np.zeros(3))
        rng = np.random.default_rng(number)
        depth = depth_from(T, "ball on a table", rng)
        masks.append(np.abs(depth - depth_from(T, "table", rng)) > 0.03)

        def given(depth: Any = depth, name: str = str(number)) -> Any:
            if read is not None:
                read.append(name)
            return depth

        frames.append(StoredFrame(str(number), CAMERA, T, given))
    return Recording("turns", "made", tuple(frames)), masks


def told(masks: list[Any], wrong: tuple[int, ...]) -> list[ImageDetection]:
    """The ball's masks; in ``wrong`` frames that of a part of the table, elsewhere for each."""
    out = []
    for number, mask in enumerate(masks):
        if number in wrong:
            mask = np.zeros_like(mask)
            mask[108:, 10 + 60 * number : 30 + 60 * number] = True
        out.append(ImageDetection(frame=str(number), mask=mask))
    return out


def test_a_detection_of_another_thing_is_left_out_and_named() -> None:
    recording, masks = recording_of_turns([0.0, 15.0, -15.0])
    found = recorded_scene(recording, told(masks, (1,)), BOUNDS, METERS)
    np.testing.assert_allclose(found.box.center.numpy(), CENTER, atol=0.3 * RADIUS)
    assert any("another object than 1" in note for note in found.notes)
    assert found.camera.frame == "0"


def test_detections_that_show_no_common_thing_are_refused() -> None:
    recording, masks = recording_of_turns([0.0, 15.0])
    with pytest.raises(InvalidDetectionError, match="the detections of the frames 0, 1 show no common object"):
        recorded_scene(recording, told(masks, (1,)), BOUNDS, METERS)


def test_frames_that_look_elsewhere_are_not_read() -> None:
    read: list[str] = []
    recording, _ = recording_of_turns([0.0, 170.0, 10.0, -10.0], read)
    # Cameras that look away from the ball: turned about their own place.
    away = [
        StoredFrame(f"away {n}", CAMERA, about(np.zeros(3), turned([0, 1, 0], 100.0 + n), np.zeros(3)), read.clear)  # type: ignore[arg-type]
        for n in range(50)
    ]
    chosen = choose_frames(Recording("more", "made", (*away, *recording.frames)), 8, REGION)
    assert set(read) == {"0", "1", "2", "3"}
    assert min(chosen.indices) >= len(away)


def test_frames_that_show_no_common_scene_are_not_put_together() -> None:
    """As of files without poses, whose frames all are where the first camera was."""
    recording, masks = recording_of_turns([0.0, -15.0, -30.0, -45.0], axis=(1.0, 0.0, 0.0))
    same = tuple(StoredFrame(one.name, CAMERA, np.eye(4), one.depth) for one in recording.frames)
    found = recorded_scene(Recording("one place", "made", same), told(masks[:1], ()), BOUNDS, METERS)
    assert found.frames == ("0",)
    assert any("Only the frame 0 is used" in note for note in found.notes)
    np.testing.assert_allclose(found.box.center.numpy()[2], 1.0, atol=0.3)
