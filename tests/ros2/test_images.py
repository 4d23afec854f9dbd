"""From images and 2D detections to poses: messages from their bytes, the request byte by byte, what is published."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from regnf_core import Sim3
from regnf_core.detections.images import read_image_detections
from regnf_data.recordings.camera import camera_of_values
from regnf_data.recordings.detection import mask_of
from tests.ros2.conftest import Buffer, Node
from tests.ros2.definitions import boxes, camera_info, header, image, masks, received
from tests.ros2.messages import TYPES
from tests.ros2.test_package import CHAIR, contract_takes, make_node, matrix, part

CUP, FRAME = "ee" * 32, "fa" * 32
H, W = 12, 16
K = (20.0, 21.0, 7.5, 5.5)
T_MAP_CAMERA = Sim3.from_quaternion(1.0, [0.5, -0.5, 0.5, -0.5], [0.3, -1.2, 0.9])
T_CAMERA_OBJECT = Sim3.from_quaternion(0.001, [0.1, 0.2, -0.3, 0.9], [0.05, -0.02, 1.1])
"""Of an object in millimeters."""
BOUNDS = [[-50.0, -40.0, 0.0], [50.0, 40.0, 120.0]]
MILLIMETERS = np.arange(1000, 1000 + H * W, dtype=np.uint16).reshape(H, W)
pytestmark = pytest.mark.usefixtures("ros")
Array = NDArray[Any]


class Answers:
    """A service that finds the object where it is in the camera's frame. world: its own frame of the scene, if it does
    not take the camera's pose that is sent."""

    def __init__(
        self,
        error: dict[str, Any] | None = None,
        verdict: str = "registered",
        bounds: Any = BOUNDS,
        world: Sim3 | None = None,
    ) -> None:
        self.error, self.verdict, self.bounds, self.world = error, verdict, bounds, world
        self.sent: list[dict[str, bytes]] = []
        self.deleted: list[str] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path
        if request.method == "DELETE":
            self.deleted.append(path)
            return httpx.Response(204)
        if path == "/register":
            assert request.headers["prefer"] == "wait=20"
            self.sent.append(parts_of(request))
            status = "successful" if self.error is None else "failed"
            return httpx.Response(
                200, json={"id": "j", "status": status, "inputs": {"scene": FRAME}, "error": self.error}
            )
        if path.startswith("/fields/"):
            return httpx.Response(200, json={"report": {"surface_bounds": self.bounds}})
        assert path == "/jobs/j/result"
        T_scene_camera = Sim3.from_matrix(self.json("camera")["T_world_camera"]) if self.world is None else self.world
        document = {
            "verdict": self.verdict,
            "probability": 0.9,
            "level": None,
            "T_object_scene": (T_scene_camera @ T_CAMERA_OBJECT).inverse().to_dict(),
            "center_object": [0.0, 0.0, 60.0],
            "covariance": (1e-4 * np.eye(7)).tolist(),
            "camera": {"T_scene_camera": T_scene_camera.to_dict()},
        }
        return httpx.Response(200, json=document)

    def json(self, name: str, index: int = -1) -> Any:
        return json.loads(self.sent[index][name])

    def picture(self, name: str, index: int = -1) -> Array:
        return np.asarray(Image.open(io.BytesIO(self.sent[index][name]), formats=["PNG"]))


def parts_of(request: httpx.Request) -> dict[str, bytes]:
    """The parts of a form, by the rules of RFC 7578."""
    kind, _, boundary = request.headers["content-type"].partition("; boundary=")
    assert kind == "multipart/form-data"
    first, *pieces, last = request.read().split(b"--" + boundary.encode())
    assert (first, last) == (b"", b"--\r\n")
    found = {}
    for piece in pieces:
        head, _, content = piece.partition(b"\r\n\r\n")
        name = head.split(b'; name="')[1].partition(b'"')[0].decode()
        assert b"; filename=" in head
        assert name not in found
        found[name] = content.removesuffix(b"\r\n")
    return found


class Robot:
    """A node with the topics of a camera and a detector. Shots are answered at once."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answers: Any, **given: Any) -> None:
        usual = {"scene": "", "objects": f"chair={CHAIR} coffee cup={CUP}", "object_unit": "mm"}
        self.answers = answers
        self.node = make_node(monkeypatch, answers, **(usual | given))

    def hear(self, topic: str, message: Any) -> None:
        self.node.subscribed[topic][1](message)
        while not self.node.latest.empty():
            self.node.answer_shot(self.node.latest.get())

    def see(self, detections: Any, depth: Any = None, color: Any = None, info: Any = None) -> Any:
        """All messages of one time; what was published of them last."""
        self.hear("depth/camera_info", camera_info(W, H, K) if info is None else info)
        if color is not None:
            self.hear("color/image", color)
        self.hear("depth/image", image(12.5, MILLIMETERS, "16UC1") if depth is None else depth)
        self.hear("yolo/detections" if hasattr(detections.detections[0], "mask") else "detections_2d", detections)
        return self.node.found_out.sent[-1] if self.node.found_out.sent else None

    @property
    def said(self) -> str:
        return "\n".join(self.node.log.lines)


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(monkeypatch, Answers())


def moved(pose: Sim3) -> Any:
    """A geometry_msgs/TransformStamped."""
    stamped, said = TYPES["geometry_msgs/TransformStamped"](), pose.to_dict()
    turn, place = stamped.transform.rotation, stamped.transform.translation
    place.x, place.y, place.z = map(float, said["translation"])
    turn.x, turn.y, turn.z, turn.w = map(float, said["rotation_quaternion_xyzw"])
    return stamped


BOX = ("chair", (8.0, 6.0, 4.0, 5.0))
OUTLINE = [(4.0, 3.0), (12.0, 3.0), (12.0, 9.0), (4.0, 9.0)]

# What is sent.


def test_the_request_has_what_the_camera_saw(robot: Robot) -> None:
    info = camera_info(W, H, K, distortion_model="plumb_bob", d=[0.1, -0.2, 0.001, 0.002, 0.05])
    color = np.arange(H * W * 3, dtype=np.uint8).reshape(H, W, 3)
    robot.see(boxes(12.5, BOX), color=image(12.5, color, "rgb8"), info=info)
    assert set(robot.answers.sent[0]) == {"depth", "camera", "color", "request"}
    assert robot.answers.picture("depth").dtype in (np.uint16, np.int32)
    np.testing.assert_array_equal(robot.answers.picture("depth"), MILLIMETERS)
    np.testing.assert_array_equal(robot.answers.picture("color"), color)
    assert robot.answers.json("camera") == {
        "fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5, "width": W, "height": H, "depth_unit": 0.001,
        "distortion_model": "plumb_bob", "D": [0.1, -0.2, 0.001, 0.002, 0.05], "T_world_camera": np.eye(4).tolist(),
    }  # fmt: skip
    assert robot.answers.json("request") == {
        "object": CHAIR,
        "detection": {"frame": 0, "label": "chair", "score": 0.9, "box_2d": [6.0, 3.5, 10.0, 8.5]},
        "options": {"robust": {"object_unit": "mm"}},
        "pictures": True,
    }


def depths() -> dict[str, tuple[Array, str, Array, float]]:
    """Depth images, their encodings, and the steps of how many meters they are sent as."""
    meters = MILLIMETERS.astype(np.float32) / 1000.0
    holes = meters.copy()
    holes[0, :5] = np.nan, np.inf, -np.inf, -1.0, 0.0
    tenths = np.rint(holes.astype(np.float64) * 10000)
    tenths[0, :5] = 0
    far = meters.copy()
    far[0, :2] = 9.0, 70.0
    steps = MILLIMETERS.copy()
    steps[0, :2] = 9000, 0
    return {
        "whole": (MILLIMETERS, "16UC1", MILLIMETERS, 0.001),
        "mono16": (MILLIMETERS, "mono16", MILLIMETERS, 0.001),
        "meters with holes": (holes, "32FC1", tenths, 0.0001),
        "meters, far": (far, "32FC1", steps, 0.001),
        "nothing": (np.full((H, W), np.nan, np.float32), "32FC1", np.zeros((H, W)), 0.0001),
    }


@pytest.mark.parametrize("release", ["jazzy", "humble", "older"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 3, 64])
def test_depth_arrives_as_it_was(robot: Robot, release: str, big: bool, padding: int) -> None:
    for n, (name, (pixels, encoding, wanted, unit)) in enumerate(depths().items()):
        robot.see(boxes(n + 1, BOX, release=release), image(n + 1, pixels, encoding, big, padding, release=release))
        np.testing.assert_array_equal(robot.answers.picture("depth"), wanted, err_msg=name)
        assert robot.answers.json("camera")["depth_unit"] == unit


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
def test_colors_arrive_red_first(robot: Robot, encoding: str) -> None:
    wanted = np.random.default_rng(0).integers(0, 256, (H, W, 3)).astype(np.uint8)
    given = {"r": wanted, "b": wanted[..., ::-1], "m": wanted[..., 0]}[encoding[0]]
    if "a8" in encoding:
        given = np.concatenate([given, np.full((H, W, 1), 7, np.uint8)], axis=2)
    robot.see(boxes(12.5, BOX), color=image(12.52, given, encoding, padding=5))
    np.testing.assert_array_equal(robot.answers.picture("color"), wanted[..., 0] if encoding == "mono8" else wanted)


def test_without_color_no_pictures_are_asked_for(robot: Robot) -> None:
    robot.see(boxes(12.5, BOX))
    assert set(robot.answers.sent[0]) == {"depth", "camera", "request"}
    assert robot.answers.json("request")["pictures"] is False


@pytest.mark.parametrize("release", ["jazzy", "humble", "older"])
def test_boxes_of_every_layout_are_upright_and_in_pixels(robot: Robot, release: str) -> None:
    robot.see(boxes(12.5, BOX, release=release))
    assert robot.answers.json("request")["detection"]["box_2d"] == [6.0, 3.5, 10.0, 8.5]
    turned = part("images")._around(type("P", (), {"x": 8.0, "y": 6.0}), np.pi / 2, 4.0, 5.0)
    np.testing.assert_allclose(turned, [5.5, 4.0, 10.5, 8.0])


@pytest.mark.parametrize("color", [None, 1, 2])
@pytest.mark.parametrize("mask", [1, 2, 4])
def test_masks_are_scaled_to_the_image_that_is_sent(robot: Robot, color: int | None, mask: int) -> None:
    """The detector saw an image ``mask`` times as large as the depth; the color that is sent is ``color`` times."""
    outline = [(mask * u, mask * v) for u, v in OUTLINE]
    picture = None if color is None else image(12.5, np.zeros((color * H, color * W, 3), np.uint8), "rgb8")
    robot.see(masks(12.5, (mask * H, mask * W), ("coffee cup", outline)), color=picture)
    request = robot.answers.json("request")
    (one,) = read_image_detections(request["detection"])
    scale = color or 1
    assert (request["object"], one.label, one.score) == (CUP, "coffee cup", 0.8)
    np.testing.assert_allclose(np.reshape(one.mask, (-1, 2)), scale * np.array(OUTLINE))
    rows, columns = np.nonzero(mask_of(one.mask, (scale * H, scale * W)))
    assert (rows.min(), columns.min()) == (3 * scale, 4 * scale)


def test_boxes_are_of_the_color_image_also_when_none_is_near(robot: Robot) -> None:
    picture = np.zeros((2 * H, 2 * W), np.uint8)
    robot.hear("color/image", image(3.0, picture, "mono8"))
    robot.see(boxes(12.5, ("chair", (16.0, 12.0, 8.0, 10.0))))
    assert robot.answers.json("request")["detection"]["box_2d"] == [6.0, 3.5, 10.0, 8.5]
    robot.see(
        boxes(12.7, ("chair", (16.0, 12.0, 8.0, 10.0))),
        image(12.7, MILLIMETERS, "16UC1"),
        image(12.7, picture, "mono8"),
    )
    assert robot.answers.json("request")["detection"]["box_2d"] == [12.0, 7.0, 20.0, 17.0]


def test_a_mask_without_three_corners_is_its_box(robot: Robot) -> None:
    robot.see(masks(12.5, (H, W), ("chair", [(4.0, 3.0), (12.0, 9.0)])))
    assert robot.answers.json("request")["detection"]["box_2d"] == [4.0, 3.0, 12.0, 9.0]


REGION = {"x_offset": 4, "y_offset": 2, "width": 8, "height": 6}
CAMERAS: list[tuple[dict[str, Any], bool, dict[str, Any]]] = [
    ({}, False, {}),
    ({"roi": REGION}, False, {"cx": 3.5, "cy": 3.5, "width": 8, "height": 6}),
    ({"binning_x": 2, "binning_y": 2}, False, {"fx": 10.0, "fy": 10.5, "cx": 3.5, "cy": 2.5, "width": 8, "height": 6}),
    ({"roi": REGION, "binning_x": 2, "binning_y": 1}, False,
     {"fx": 10.0, "cx": 1.5, "cy": 3.5, "width": 4, "height": 6}),
    ({"width": 0, "height": 0}, False, {}),
    ({"distortion_model": "equidistant", "d": [0.1, 0.0, 0.0, 0.0]}, False,
     {"distortion_model": "equidistant", "D": [0.1, 0.0, 0.0, 0.0]}),
    ({"distortion_model": "rational_polynomial", "d": [0.1] * 8}, True, {"fx": 18.0, "fy": 19.0, "cx": 7.0, "cy": 5.0}),
    ({"distortion_model": "plumb_bob", "d": [0.0] * 5}, True, {}),
]  # fmt: skip


@pytest.mark.parametrize(("said", "rectified", "wanted"), CAMERAS)
def test_cameras_are_of_the_image_that_came(said: dict[str, Any], rectified: bool, wanted: dict[str, Any]) -> None:
    """Regions and binned pixels are those of the whole sensor's camera; rectified images have P and no lens."""
    p = [18.0, 0.0, 7.0, 0.0, 0.0, 19.0, 5.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    found = part("images").camera_of(camera_info(**{"width": W, "height": H} | said, k=K, p=p), rectified, (H, W))
    plain = {"fx": 20.0, "fy": 21.0, "cx": 7.5, "cy": 5.5, "width": W, "height": H, "distortion_model": "", "D": []}
    assert found == plain | wanted
    read = camera_of_values(found, "camera")
    assert read is not None
    lens = {"": "none", "equidistant": "fisheye"}[found["distortion_model"]]
    assert (read.camera.size, read.camera.lens) == ((found["height"], found["width"]), lens)


@pytest.mark.parametrize("topic", ["/camera/depth/image_rect", "/rectified/depth/image_raw"])
def test_a_rectified_image_is_known_by_its_topic(monkeypatch: pytest.MonkeyPatch, topic: str) -> None:
    monkeypatch.setattr(Node, "remapped", {"depth/image": topic})
    assert Robot(monkeypatch, Answers()).node.rectified == topic.endswith("rect")


def test_the_requests_are_ones_that_the_contract_takes(robot: Robot) -> None:
    robot.see(boxes(12.5, BOX))
    robot.see(masks(12.5, (H, W), ("chair", OUTLINE)))
    requests = [robot.answers.json("request", number) for number in (0, 1)]
    for request in requests:
        contract_takes("OneShotRequest", request)
    assert [{"mask", "box_2d"} & set(request["detection"]) for request in requests] == [{"box_2d"}, {"mask"}]


# What is published.


@pytest.mark.parametrize(
    "world", [None, Sim3.identity(), Sim3.from_quaternion(1.0, [0.1, 0.7, 0.2, 0.5], [3.0, 2.0, 1.0])]
)
def test_a_pose_is_published_in_the_map_where_tf_knows_it(monkeypatch: pytest.MonkeyPatch, world: Sim3 | None) -> None:
    robot = Robot(monkeypatch, Answers(world=world))
    monkeypatch.setattr(Buffer, "poses", {12.5: moved(T_MAP_CAMERA), 12.6: moved(Sim3.identity())})
    array = robot.see(boxes(12.49, BOX))
    np.testing.assert_allclose(robot.answers.json("camera")["T_world_camera"], T_MAP_CAMERA.matrix().numpy(), atol=1e-9)
    wanted = (T_MAP_CAMERA @ T_CAMERA_OBJECT).matrix().numpy()
    (one,), (pose,), (frame,) = array.detections, robot.node.pose_out.sent, robot.node.broadcaster.sent
    assert (array.header.frame_id, array.header.stamp.sec, array.header.stamp.nanosec) == ("map", 12, 500_000_000)
    assert (one.id, one.results[0].hypothesis.score) == ("chair/0/level=none/scale=0.001", 0.9)
    np.testing.assert_allclose(matrix(pose.pose.pose, 0.001), wanted, atol=1e-6)
    assert (frame.header.frame_id, frame.child_frame_id) == ("map", "regnf/chair_0")
    assert np.any(pose.pose.covariance)
    # the object's own box, 100 x 80 x 120 mm, whose middle is 60 mm above its origin
    middle, size = one.bbox.center.position, one.bbox.size
    np.testing.assert_allclose([middle.x, middle.y, middle.z], (wanted @ [0.0, 0.0, 60.0, 1.0])[:3], atol=1e-6)
    np.testing.assert_allclose([size.x, size.y, size.z], [0.1, 0.08, 0.12], atol=1e-6)


@pytest.mark.parametrize("map_frame", ["", "map"])
def test_without_a_map_the_camera_is_the_world(monkeypatch: pytest.MonkeyPatch, map_frame: str) -> None:
    robot = Robot(monkeypatch, Answers(bounds=None), map_frame=map_frame, up_axis="z")
    array = robot.see(boxes(12.5, BOX))
    assert array.header.frame_id == "camera"
    assert ("tf has no transform from 'camera' to 'map'" in robot.said) == bool(map_frame)
    assert "up_axis" not in robot.answers.json("request")["options"]
    wanted = T_CAMERA_OBJECT.matrix().numpy()
    np.testing.assert_allclose(matrix(robot.node.pose_out.sent[0].pose.pose, 0.001), wanted, atol=1e-6)
    box = array.detections[0].bbox
    assert box.size.x == 0.0
    np.testing.assert_allclose(box.center.position.z, (wanted @ [0.0, 0.0, 60.0, 1.0])[2], atol=1e-6)


def test_a_map_that_tf_does_not_know_at_that_time_is_said(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Buffer, "poses", {11.0: moved(T_MAP_CAMERA)})
    assert robot.see(boxes(12.5, BOX)) is None
    assert "no transform from camera to map at 12.5" in robot.said
    assert robot.answers.sent == []
    monkeypatch.setattr(Buffer, "poses", {12.5: moved(T_MAP_CAMERA)})
    robot.see(boxes(12.5, BOX))
    assert robot.answers.json("request")["object"] == CHAIR


def test_several_detections_of_one_image_are_one_array(robot: Robot) -> None:
    things = [("lamp", OUTLINE), ("coffee cup", OUTLINE), ("chair", OUTLINE)]
    array = robot.see(masks(12.5, (H, W), *things))
    assert [one.id.partition("/level")[0] for one in array.detections] == ["coffee cup/1", "chair/2"]
    assert [robot.answers.json("request", n)["object"] for n in (0, 1)] == [CUP, CHAIR]
    assert robot.answers.sent[0]["depth"] == robot.answers.sent[1]["depth"]
    assert robot.answers.deleted == [f"/recordings/{FRAME}"]
    assert "no object for the class 'lamp'" in robot.said


@pytest.mark.parametrize(
    ("answers", "detections", "told"),
    [
        (Answers({"reason": "DETECTION_WITHOUT_DEPTH"}), boxes(12.5, BOX), "chair: DETECTION_WITHOUT_DEPTH"),
        (lambda _: httpx.Response(503, json={"reason": "QUEUE_FULL"}), boxes(12.5, BOX), "QUEUE_FULL"),
        (lambda _: httpx.Response(502, text="<html>"), boxes(12.5, BOX), "ANSWER_UNREADABLE"),
        (Answers(verdict="rejected"), boxes(12.5, BOX), "chair: rejected"),
        (Answers(), boxes(12.5, ("lamp", (8.0, 6.0, 4.0, 5.0))), "no object for the class 'lamp'"),
        (Answers(), boxes(12.5, ("", (8.0, 6.0, 4.0, 5.0))), "no object for the class ''"),
        (Answers(), boxes(12.5, ("chair", (8.0, 6.0, 0.0, 5.0))), "has no area"),
        (Answers(), boxes(12.5, ("chair", (float("nan"), 6.0, 4.0, 5.0))), "has no area"),
        (Answers(), masks(12.5, (W, H), ("chair", OUTLINE)), "subscribe to depth that is aligned"),
    ],
)  # fmt: skip
def test_what_is_not_found_is_said(monkeypatch: pytest.MonkeyPatch, answers: Any, detections: Any, told: str) -> None:
    robot = Robot(monkeypatch, answers)
    array = robot.see(detections)
    assert array.detections == robot.node.pose_out.sent == robot.node.broadcaster.sent == []
    assert told in robot.said


SHORT = received(
    "sensor_msgs/Image", {"header": header(12.5), "encoding": "16UC1", "height": H, "width": W, "step": 2 * W}
)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"depth": image(12.5, np.zeros((H, W), np.uint8), "mono8")}, "encoding 'mono8', expected one of 16UC1"),
        ({"depth": SHORT}, "has 0 bytes"),
        ({"info": camera_info(W, H, (0.0, 0.0, 0.0, 0.0))}, "not calibrated"),
        ({"info": camera_info(W, H, (float("nan"), 1.0, 1.0, 1.0))}, "not calibrated"),
        ({"color": image(12.5, np.zeros((H, W), np.uint16), "16UC1")}, "encoding '16UC1', expected one of rgb8"),
        ({"color": image(12.5, np.zeros((W, H, 3), np.uint8), "rgb8")}, "aligned to the color image"),
    ],
)  # fmt: skip
def test_images_that_are_of_no_use_are_said(robot: Robot, given: dict[str, Any], told: str) -> None:
    assert robot.see(boxes(12.5, BOX), **given) is None
    assert told in robot.said
    assert robot.answers.sent == []


def test_depth_of_another_frame_than_the_color_is_said(robot: Robot) -> None:
    robot.see(boxes(12.5, BOX), color=image(12.5, np.zeros((H, W), np.uint8), "mono8", frame="color"))
    assert "depth is of 'camera', color of 'color'. Check that the depth is aligned to the color image." in robot.said


def test_equal_warnings_are_said_once(robot: Robot) -> None:
    for stamp in (1.0, 2.0, 3.0):
        robot.see(boxes(stamp, ("lamp", (8.0, 6.0, 4.0, 5.0))), image(stamp, MILLIMETERS, "16UC1"))
    assert robot.node.log.lines == ["no object for the class 'lamp'"]


def test_an_image_that_is_still_needed_goes_the_next_time(monkeypatch: pytest.MonkeyPatch) -> None:
    answers, refused = Answers(), [True]

    def busy(request: httpx.Request) -> httpx.Response:
        if request.method == "DELETE" and refused:
            refused.pop()
            return httpx.Response(409, json={"reason": "FIELD_IN_USE", "detail": "a job needs it"})
        return answers(request)

    robot = Robot(monkeypatch, busy)
    robot.see(boxes(12.5, BOX))
    assert answers.deleted == []
    robot.see(boxes(12.5, BOX))
    assert answers.deleted == [f"/recordings/{FRAME}"]


def test_a_box_in_space_needs_a_scene(robot: Robot) -> None:
    from tests.ros2.test_package import detections

    robot.node.answer(detections())
    assert "parameter scene" in robot.said


# Which messages belong together.


class Stream:
    """A matcher; what it gives, as pairs of the depth's and the detections' stamps."""

    def __init__(self, info: bool = True) -> None:
        self.said: list[str] = []
        self.matcher = part("matching").Matcher(self.said.append)
        if info:
            self.matcher.add_info(camera_info(W, H, K))

    def depth(self, *stamps: float) -> list[tuple[float, float]]:
        return self._pairs(self.matcher.add_depth, [image(stamp, MILLIMETERS, "16UC1") for stamp in stamps])

    def boxes(self, *stamps: float) -> list[tuple[float, float]]:
        return self._pairs(self.matcher.add_detections, [boxes(stamp, BOX) for stamp in stamps])

    def _pairs(self, add: Callable[[Any], list[Any]], messages: list[Any]) -> list[tuple[float, float]]:
        shots = [shot for message in messages for shot in add(message)]
        stamp = part("matching").stamp_of
        return [(stamp(shot.depth) / 1e9, stamp(shot.detections) / 1e9) for shot in shots]


def test_detections_are_matched_to_the_nearest_depth_in_any_order() -> None:
    stream = Stream()
    assert stream.depth(1.0, 1.1, 1.2, 1.3) == []
    assert stream.boxes(1.1, 1.26) == [(1.1, 1.1), (1.3, 1.26)]
    assert stream.boxes(1.4, 1.52) == []  # the depth is yet to come
    assert stream.depth(1.4) == [(1.4, 1.4)]
    assert stream.depth(1.5) == []  # the next may be nearer
    assert stream.depth(1.6) == [(1.5, 1.52)]
    assert stream.said == []


def test_detections_that_match_nothing_are_dropped_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream()
    stream.depth(1.0, 3.0)
    assert stream.boxes(2.0) == []
    assert "no depth image is within 0.1 s" in stream.said[-1]
    assert stream.boxes(0.5) == []
    assert "too late: the oldest stored depth image is 0.5 s newer" in stream.said[-1]
    assert stream.boxes(0.0) == []
    assert "without a time stamp" in stream.said[-1]
    stream.boxes(*(4.0 + n for n in range(part("matching").MOST_WAITING + 1)))
    assert "no later depth image has arrived" in stream.said[-1]
    monkeypatch.setattr(part("matching"), "MOST_BYTES", 3 * MILLIMETERS.nbytes)
    stream.depth(*(30.0 + n for n in range(9)))
    stream.boxes(35.0)
    assert "the oldest stored depth image is 1.0 s newer" in stream.said[-1]


def test_detections_wait_for_the_camera() -> None:
    stream = Stream(info=False)
    stream.depth(1.0)
    assert stream.boxes(1.0) == []
    stream.matcher.add_info(camera_info(W, H, K))
    assert stream.depth(1.1) == [(1.0, 1.0)]
    stream = Stream(info=False)
    stream.boxes(*(4.0 + n for n in range(part("matching").MOST_WAITING + 1)))
    assert "no camera_info has arrived" in stream.said[-1]


def test_a_recording_that_starts_again_is_matched_again() -> None:
    stream = Stream()
    stream.depth(1.0, 5.0)
    assert stream.depth(1.0) == []
    assert stream.boxes(1.0) == [(1.0, 1.0)]
    assert stream.boxes(1.15) == []
    assert stream.depth(1.2) == [(1.2, 1.15)]
    assert stream.said == []


def test_only_the_latest_image_waits_for_the_service(robot: Robot) -> None:
    node = robot.node
    node.subscribed["depth/camera_info"][1](camera_info(W, H, K))
    for stamp in (1.0, 1.1, 1.2):
        node.subscribed["depth/image"][1](image(stamp, MILLIMETERS, "16UC1"))
        node.subscribed["detections_2d"][1](boxes(stamp, BOX))
    assert part("matching").stamp_of(node.latest.get().detections) == 1_200_000_000
    assert "some were dropped" in robot.said


def test_a_recorded_bag_played_to_the_node(robot: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its camera moves: each image is asked for with the pose that tf has at its own time."""
    from rosbags.highlevel import AnyReader

    from tests.data.recordings.truth import walk
    from tests.data.recordings.writers import OPTICAL, bag

    truth = walk(3)
    topics = {"/camera/depth/image_rect_raw": "depth/image", "/camera/depth/camera_info": "depth/camera_info",
              "/camera/color/image": "color/image"}  # fmt: skip
    known: dict[float, Any] = {}
    monkeypatch.setattr(Buffer, "poses", known)
    with AnyReader([bag(tmp_path / "bag", truth)]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/tf":
                (link,) = message.transforms
                turn, place = link.transform.rotation, link.transform.translation
                body = Sim3.from_quaternion(1.0, [turn.x, turn.y, turn.z, turn.w], [place.x, place.y, place.z])
                stamp = link.header.stamp
                known[stamp.sec + 1e-9 * stamp.nanosec] = moved(body @ Sim3.from_matrix(OPTICAL.tolist()))
            elif connection.topic in topics:
                robot.hear(topics[connection.topic], message)
            if connection.topic == "/camera/color/image":
                stamp = message.header.stamp
                robot.hear(
                    "detections_2d", boxes(stamp.sec + 1e-9 * stamp.nanosec, ("chair", (40.0, 30.0, 20.0, 20.0)))
                )
    assert len(robot.answers.sent) == 2  # after the last color no depth came that may be nearer
    for n, (pose, depth) in enumerate(zip(truth.poses[:2], truth.depths[:2], strict=True)):
        np.testing.assert_allclose(robot.answers.json("camera", n)["T_world_camera"], pose, atol=1e-6)
        np.testing.assert_array_equal(robot.answers.picture("depth", n), np.round(1000.0 * depth))
    assert {array.header.frame_id for array in robot.node.found_out.sent} == {"map"}
