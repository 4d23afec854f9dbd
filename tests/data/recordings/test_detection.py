"""Detections in images: every way to write one, and where they are in space."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from regnf_core.detections.images import ImageDetection, is_image_detection, read_image_detections
from regnf_core.errors import InvalidDetectionError
from regnf_data.recordings.camera import Camera
from regnf_data.recordings.detection import lift, mask_of
from regnf_data.recordings.recording import Frame, Recording, StoredFrame
from regnf_data.recordings.stored import read_stored, recording_of_frames, write_recording

H, W = 120, 160
CAMERA = Camera(np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]]), (H, W))
CENTER, RADIUS = np.array([0.05, 0.02, 0.9]), 0.12
"""A ball before a wall at 1.5 m, on a table whose top lies at y = 0.14 in the camera's frame."""
WALL, TABLE = 1.5, 0.14


def ball_image() -> tuple[Frame, np.ndarray[Any, np.dtype[np.bool_]]]:
    """The depth by formulas, and which pixels show the ball."""
    rows, columns = np.indices((H, W)) + 0.5
    rays = CAMERA.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)).reshape(H, W, 3)
    with np.errstate(divide="ignore"):
        depth = np.minimum(WALL, np.where(rays[..., 1] > 0.0, TABLE / rays[..., 1], np.inf))
    a, b, c = (rays**2).sum(-1), rays @ CENTER, CENTER @ CENTER - RADIUS**2
    root = b * b - a * c
    hit = (b - np.sqrt(np.maximum(root, 0.0))) / a
    shown = (root > 0.0) & (hit < depth)
    return Frame("0", np.where(shown, hit, depth).astype(np.float32), CAMERA, np.eye(4)), shown


def grown(mask: Any, pixels: int) -> Any:
    from scipy import ndimage

    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    return change(mask, iterations=abs(pixels)) if pixels else mask


MASK = np.zeros((3, 4), np.bool_)
MASK[1:, 1:3] = True
# Down the columns: 000 011 011 000, so runs of 4, 2, 1, 2, 3. As text: one character a number, differences from the
# third number on: 4, 2, 1, 2 - 2, 3 - 1.
RUNS = [4, 2, 1, 2, 3]
TEXT = "".join(chr(48 + value) for value in (4, 2, 1, 0, 2))


def png_of(mask: Any) -> str:
    file = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * 255).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


@pytest.mark.parametrize(
    "given",
    [
        {"mask": {"size": [3, 4], "counts": RUNS}},
        {"mask": {"size": [3, 4], "counts": TEXT}},
        {"mask": "mask.png"},
        {"mask": f"data:image/png;base64,{png_of(MASK)}"},
        {"image_id": 0, "category_id": 3, "segmentation": {"size": [3, 4], "counts": RUNS}, "bbox": [1, 1, 2, 2]},
    ],
)
def test_a_mask_is_read_however_it_is_written(given: dict[str, Any], tmp_path: Path) -> None:
    Image.fromarray(MASK.astype(np.uint8)).save(tmp_path / "mask.png")
    assert is_image_detection(given)
    (found,) = read_image_detections(given)
    np.testing.assert_array_equal(mask_of(found.beside(tmp_path).mask), MASK)


def picture(**how: Any) -> str:
    """A mask as a picture that is made of it in another way, as base64."""
    image = Image.fromarray(how["pixels"], how.get("mode"))
    if "palette" in how:
        image.putpalette(how["palette"])
    file = io.BytesIO()
    image.save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


_ONES, _SIZE = MASK.astype(np.uint8), MASK.shape
PICTURES = {
    "ones": picture(pixels=_ONES),
    "16 bits": picture(pixels=_ONES.astype(np.uint16) * 65535),
    "white with alpha": picture(pixels=np.dstack([_ONES * 0 + 255] * 3 + [_ONES * 255])),
    "black with alpha": picture(pixels=np.dstack([_ONES * 0] * 3 + [_ONES * 255])),
    "opaque": picture(pixels=np.dstack([_ONES * 255] * 3 + [_ONES * 0 + 255])),
    "palette": picture(pixels=_ONES, palette=[0, 0, 0, 128, 0, 0]),
    "palette without black": picture(pixels=_ONES, palette=[9, 9, 9, 128, 0, 0]),
    "probabilities": picture(pixels=25 + 204 * _ONES),
}


@pytest.mark.parametrize("kind", PICTURES)
def test_a_mask_is_read_from_pictures_of_any_kind(kind: str) -> None:
    np.testing.assert_array_equal(mask_of(PICTURES[kind]), MASK)


SQUARE = [[40.0, 30.0, 120.0, 30.0, 120.0, 90.0, 40.0, 90.0]]
SHARES = [[one / (160.0, 120.0)[at % 2] for at, one in enumerate(SQUARE[0])]]


@pytest.mark.parametrize(
    "mask",
    [SQUARE, SQUARE[0], [SQUARE[0][at : at + 2] for at in range(0, 8, 2)], SHARES, SHARES[0]],
    ids=["polygons", "one", "pairs", "shares", "shares of one"],
)
def test_a_polygon_is_read_however_it_is_written(mask: Any) -> None:
    found = mask_of(mask, (120, 160))
    assert found[31:89, 41:119].all()
    assert found.sum() <= 61 * 81


@pytest.mark.parametrize("kind", ["rows of ones", "half as large", "shares of the sides"])
def test_a_detection_of_other_pixels_is_that_thing(kind: str) -> None:
    frame, shown = ball_image()
    rows, columns = np.nonzero(shown)
    box = columns.min() / 160, rows.min() / 120, (columns.max() + 1) / 160, (rows.max() + 1) / 120
    given = {"rows of ones": {"mask": shown.tolist()}, "half as large": {"mask": shown[::2, ::2]}}
    found = lift(frame, ImageDetection(**given.get(kind, {"box_2d": box})))
    assert (found.pixels & shown).sum() > 0.9 * shown.sum()


def test_a_mask_that_is_inverted_is_refused() -> None:
    frame, shown = ball_image()
    with pytest.raises(InvalidDetectionError, match="whether it is inverted"):
        lift(frame, ImageDetection(mask=~shown))


def test_annotations_of_coco_name_their_image_and_their_category() -> None:
    listed = {
        "images": [{"id": 7, "file_name": "rgb/000003.png", "height": 12, "width": 16}],
        "categories": [{"id": 3, "name": "cup"}],
        "annotations": [{"image_id": 7, "category_id": 3, "segmentation": [], "bbox": [10, 20, 20, 40]}],
    }
    (found,) = read_image_detections(listed)
    assert (found.frame, found.label, found.size, found.box_2d) == ("000003.png", "cup", (12, 16), (10, 20, 30, 60))
    frames = [replace(ball_image()[0], name=name) for name in ("000001", "000003", "100.1000", "100.2000")]
    recording = recording_of_frames(frames)
    assert [recording.index(name) for name in (found.frame, 3, "3", 1, 0, "100.2000")] == [1, 1, 1, 0, 0, 3]
    alone = recording_of_frames(frames[:1])
    assert [alone.index(name) for name in (7, "rgb/color.png")] == [0, 0]


@pytest.mark.parametrize(
    "given",
    [
        {"frame": "7", "box_2d": [10, 20, 30, 60]},
        [{"image_id": 7, "category_id": 1, "bbox": [10, 20, 20, 40], "score": 0.5}],
        [{"name": "cup", "class": 41, "confidence": 0.5, "box": {"x1": 10, "y1": 20, "x2": 30, "y2": 60}}],
        {"annotations": [{"image_id": 7, "bbox": [10, 20, 20, 40]}]},
    ],
)
def test_a_box_is_read_however_it_is_written(given: Any) -> None:
    assert is_image_detection(given)
    (found,) = read_image_detections(given)
    assert found.box_2d == (10.0, 20.0, 30.0, 60.0)
    assert found.score in (None, 0.5)


def test_of_several_detections_one_is_chosen() -> None:
    listed = [{"name": "cup", "bbox": [0, 0, 5, 5]}, {"name": "bowl", "bbox": [10, 20, 20, 40]}]
    with pytest.raises(InvalidDetectionError, match=r"there are 2 detections; choose one \(0: cup, 1: bowl\)"):
        read_image_detections(listed)
    assert read_image_detections(listed, index=1)[0].label == "bowl"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"box_2d": [30, 20, 10, 60]}, "no area"),
        ({"box_2d": [1, 2, 3]}, "not 4 finite numbers"),
        ({"point_2d": ["a", 2]}, "not 2 finite numbers"),
        ({"label": "cup"}, "needs a mask, a box_2d or a point_2d"),
    ],
)
def test_what_is_wrong_is_said(given: Any, said: str) -> None:
    with pytest.raises(InvalidDetectionError, match=said):
        read_image_detections(given)


@pytest.mark.parametrize(
    ("mask", "said"),
    [
        ({"size": [3, 4], "counts": [4, 2]}, "runs have 6 pixels, its size 4 x 3"),
        ("no such file", "not a file, not a base64 image"),
        (np.zeros((3, 4, 3)), r"shape \(3, 4, 3\)"),
    ],
)
def test_what_is_wrong_with_a_mask_is_said(mask: Any, said: str) -> None:
    with pytest.raises(InvalidDetectionError, match=said):
        mask_of(mask)


@pytest.mark.parametrize("kind", ["mask", "mask grown", "mask shrunk", "box", "box loose", "point", "point beside"])
def test_a_thing_is_lifted_to_its_box(kind: str) -> None:
    frame, shown = ball_image()
    rows, columns = np.nonzero(shown)
    tight = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    middle = float(columns.mean()), float(rows.mean())
    detection = {
        "mask": ImageDetection(mask=shown),
        "mask grown": ImageDetection(mask=grown(shown, 4)),
        "mask shrunk": ImageDetection(mask=grown(shown, -3)),
        "box": ImageDetection(box_2d=tight),
        "box loose": ImageDetection(box_2d=(tight[0] - 9, tight[1] - 9, tight[2] + 9, tight[3] + 9)),
        "point": ImageDetection(point_2d=middle),
        "point beside": ImageDetection(point_2d=(middle[0] + 8, middle[1] - 6)),
    }[kind]
    found = lift(frame, detection, diameter=2.0 * RADIUS)
    # Nearly all pixels are the ball's, and most of the ball's are among them.
    assert (found.pixels & shown).sum() >= 0.95 * found.pixels.sum()
    assert (found.pixels & shown).sum() >= 0.7 * shown.sum()
    # The box holds the visible cap, and is not much larger than the ball.
    np.testing.assert_allclose(found.box.center.numpy(), CENTER, atol=0.3 * RADIUS)
    size = found.box.size.numpy()
    assert (size > 1.4 * RADIUS).all()
    assert (size < 3.0 * RADIUS).all()


@pytest.mark.parametrize(
    ("detection", "said"),
    [
        (ImageDetection(mask=np.zeros((H, W), np.bool_)), "frame 0: the mask is empty"),
        (ImageDetection(mask=np.ones((9, 9), np.bool_)), "frame 0: the mask has 9 x 9 pixels, not 160 x 120"),
        (ImageDetection(box_2d=(500.0, 0.0, 600.0, 50.0)), "frame 0: the box is outside the image"),
        (ImageDetection(point_2d=(-1.0, 5.0)), "frame 0: the point .* is outside the image"),
    ],
)
def test_a_detection_beside_the_image_is_refused(detection: ImageDetection, said: str) -> None:
    with pytest.raises(InvalidDetectionError, match=said):
        lift(ball_image()[0], detection)


def test_a_detection_without_depth_is_refused() -> None:
    frame, shown = ball_image()
    holes = Frame("0", np.where(shown, 0.0, frame.depth).astype(np.float32), CAMERA, np.eye(4))
    with pytest.raises(
        InvalidDetectionError, match=r"frame 0: depth was measured in 0 of \d+ pixels of the detection"
    ) as found:
        lift(holes, ImageDetection(mask=shown))
    assert found.value.reason == "DETECTION_WITHOUT_DEPTH"


@pytest.mark.parametrize("kind", ["mask grown", "mask shrunk", "mask shifted", "box loose", "point"])
def test_the_box_does_not_depend_on_how_the_thing_was_detected(kind: str) -> None:
    frame, shown = ball_image()
    rng = np.random.default_rng(1)
    frame = Frame("0", (frame.depth * (1 + 0.001 * rng.normal(size=(H, W)))).astype(np.float32), CAMERA, np.eye(4))
    rows, columns = np.nonzero(shown)
    left, top, right, bottom = columns.min() - 6.0, rows.min() - 6.0, columns.max() + 7.0, rows.max() + 7.0
    detection = {
        "mask grown": ImageDetection(mask=grown(shown, 6)),
        "mask shrunk": ImageDetection(mask=grown(shown, -5)),
        "mask shifted": ImageDetection(mask=np.roll(shown, (3, -4), axis=(0, 1))),
        "box loose": ImageDetection(box_2d=(left, top, right, bottom)),
        "point": ImageDetection(point_2d=(float(columns.mean()), float(rows.mean()))),
    }[kind]
    exact, found = (lift(frame, one, diameter=3.5 * RADIUS) for one in (ImageDetection(mask=shown), detection))
    assert np.abs((found.box.center - exact.box.center).numpy()).max() < 0.05 * RADIUS
    np.testing.assert_allclose(found.box.size.numpy(), exact.box.size.numpy(), rtol=0.05)


@pytest.mark.parametrize("colored", [True, False])
def test_a_mask_is_in_pixels_of_the_image_with_its_lens(colored: bool, tmp_path: Path) -> None:
    """A lens that bends the image's corner by several pixels; the mask is drawn on the bent image."""
    bent = replace(CAMERA, lens="brown", distortion=(-0.25, 0.05, 0.0, 0.0))
    depth, color = np.ones((H, W), np.float32), np.zeros((H, W, 3), np.uint8)
    stored = StoredFrame("0", bent, np.eye(4), lambda: depth, (lambda: color) if colored else None)
    write_recording(Recording("r", "frames", (stored,)), [0], tmp_path / "r.safetensors")
    rows, columns = np.indices((H, W))
    corner = (rows > 88) & (rows < 104) & (columns > 128) & (columns < 144)
    seen = bent.project(CAMERA.rays(np.stack(np.nonzero(corner)[::-1], axis=1).astype(np.float64) + 0.5))
    assert np.abs(seen - (np.stack(np.nonzero(corner)[::-1], axis=1) + 0.5)).max() > 3.0
    mask = np.zeros((H, W), np.bool_)
    mask[np.floor(seen[:, 1]).astype(int), np.floor(seen[:, 0]).astype(int)] = True
    for frame in (stored.read(), read_stored(tmp_path / "r.safetensors").frames[0].read()):
        np.testing.assert_array_equal(frame.registered(mask)[corner], True)
        assert frame.registered(mask).sum() < 1.2 * corner.sum()
