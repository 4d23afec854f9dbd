"""The node: boxes in space, or images with 2D detections, in; poses out. Topics: docs/how-to/robot.md of regnf."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, Full, Queue
from threading import Thread
from time import monotonic
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.duration import Duration
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener
from vision_msgs.msg import Detection2DArray, Detection3D, Detection3DArray, ObjectHypothesisWithPose

from regnf_ros.images import camera_image, seen_in
from regnf_ros.matching import Matcher, Shot
from regnf_ros.objects import Asked, Found, Registrar
from regnf_ros.parameters import axis_of, objects_of, share_of, text_of, token_of, unit_of
from regnf_ros.poses import Box, Matrix, ObjectPose, field_from_map, quaternion_xyzw, rigid
from regnf_ros.service import Service, ServiceError

try:
    from yolo_msgs.msg import DetectionArray
except ImportError:  # of the package yolo_ros, which need not be there
    DetectionArray = None

TEXTS = ("server", "token_file", "scene", "map_frame", "dataparser_transforms")
PARAMETERS = (*TEXTS, "objects", "up_axis", "scale_tolerance", "object_unit")
DEFAULTS = {"server": "http://127.0.0.1:8080", "map_frame": "map", "object_unit": "auto"}
WAITING = 16
"""Arrays of boxes that may wait for the service; later ones are dropped, which is said in the log."""
WAIT_S = 0.5
"""How long tf may take to say where the camera was."""
QUIET_S = 10.0
"""Between two equal warnings, at least: a camera sends thirty images a second."""
MOST_WARNINGS = 100
"""That are kept to be compared."""


class RegisterObjects(Node):
    """Registers each detection and publishes what is found. Threads of their own talk to the service."""

    def __init__(self) -> None:
        super().__init__("regnf")
        # of any type: YAML makes a boolean of `up_axis: y`, and a parameter of one type would end the node there
        any_type = ParameterDescriptor(dynamic_typing=True)
        given = {name: self.declare_parameter(name, DEFAULTS.get(name, ""), any_type).value for name in PARAMETERS}
        said = {name: text_of(name, given[name]) for name in TEXTS}
        self.map_frame = said["map_frame"]
        asked = Asked(
            scene=said["scene"],
            objects=objects_of(given["objects"]),
            T_field_map=field_from_map(said["dataparser_transforms"]),
            up_axis=axis_of("up_axis", given["up_axis"]),
            scale_tolerance=share_of("scale_tolerance", given["scale_tolerance"]),
            object_unit=unit_of("object_unit", given["object_unit"]),
        )
        self.registrar = Registrar(Service(said["server"], token_of(said["token_file"])), asked)
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)
        self.broadcaster = TransformBroadcaster(self)
        self.found_out = self.create_publisher(Detection3DArray, "objects", 10)
        self.pose_out = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.waiting: Queue[Detection3DArray] = Queue(WAITING)
        self.latest: Queue[Shot] = Queue(1)
        self.matcher = Matcher(self.warn)
        self.warned: dict[str, float] = {}
        self.create_subscription(Detection3DArray, "detections", self.take, 10)
        self.subscribe_to_images()
        Thread(target=self.work, args=(self.waiting, self.answer), daemon=True).start()
        Thread(target=self.work, args=(self.latest, self.answer_shot), daemon=True).start()

    def subscribe_to_images(self) -> None:
        def take(kind: type, topic: str, add: Callable[[Any], Any]) -> None:
            self.create_subscription(kind, topic, add, qos_profile_sensor_data)

        matcher = self.matcher
        take(CameraInfo, "depth/camera_info", matcher.add_info)
        take(Image, "color/image", matcher.add_color)
        take(Image, "depth/image", lambda message: self.take_shots(matcher.add_depth(message)))
        arrays = [(Detection2DArray, "detections_2d"), (DetectionArray, "yolo/detections")]
        for kind, topic in arrays:
            if kind is not None:
                take(kind, topic, lambda message: self.take_shots(matcher.add_detections(message)))
        # by ROS's names of topics: image_rect, image_rect_raw
        self.rectified = "rect" in self.resolve_topic_name("depth/image").rpartition("/")[2]

    # Called by the executor: these never wait.

    def take(self, message: Detection3DArray) -> None:
        try:
            self.waiting.put_nowait(message)
        except Full:
            self.get_logger().warning("the service is slower than the detections: one array was dropped")

    def take_shots(self, shots: list[Shot]) -> None:
        """The latest counts: one that still waits is dropped."""
        for shot in shots:
            with suppress(Empty):
                self.latest.get_nowait()
                self.warn("the service is slower than the detections in images: some were dropped")
            self.latest.put_nowait(shot)

    def warn(self, text: str) -> None:
        now = monotonic()
        if now - self.warned.get(text, -QUIET_S) < QUIET_S:
            return
        if len(self.warned) >= MOST_WARNINGS:
            self.warned.clear()
        self.warned[text] = now
        self.get_logger().warning(text)

    # Called by threads of their own.

    def work(self, waiting: Queue[Any], answer: Callable[[Any], None]) -> None:
        """What is foreseen is caught below. Anything else ends the node, which must not run on without answering."""
        try:
            while True:
                answer(waiting.get())
        finally:
            rclpy.try_shutdown()

    def answer(self, message: Detection3DArray) -> None:
        """Registers all detections of a message and publishes what was found."""
        found: dict[int, Found] = {}
        for number, detection in enumerate(message.detections):
            class_id = best_class(detection)
            if class_id is not None and self.knows(class_id):
                self.keep(found, number, class_id, partial(self.find, class_id, detection, message))
        self.publish(found, message.header.stamp, self.map_frame)

    def find(self, class_id: str, detection: Detection3D, message: Detection3DArray) -> Found | None:
        return self.registrar.find(class_id, self.box_in_map(detection, message))

    def answer_shot(self, shot: Shot) -> None:
        """The same of 2D detections, with the image that they were made in."""
        found: dict[int, Found] = {}
        header, frame = shot.depth.header, shot.depth.header.frame_id  # the camera's, unless the map is known
        known = [(number, one) for number, one in enumerate(seen_in(shot.detections)) if self.knows(one.class_id)]
        if known:
            if shot.color is not None and shot.color.header.frame_id != frame:
                self.warn(
                    f"depth is of {frame!r}, color of {shot.color.header.frame_id!r}. Check that the depth "
                    f"is aligned to the color image."
                )
            try:
                T_map_camera = self.camera_in_map(header)
                image = camera_image(shot.depth, shot.info, shot.color, T_map_camera, self.rectified)
            except (TransformException, ValueError) as error:
                self.warn(f"no object is searched: {error}")
                return
            frame, size = frame if T_map_camera is None else self.map_frame, shot.color_size or image.size
            for number, one in known:
                self.keep(found, number, one.class_id, partial(self.registrar.find_in_image, one, image, size))
            self.registrar.forget()
        self.publish(found, header.stamp, frame)

    def knows(self, class_id: str | None) -> bool:
        known = class_id is not None and self.registrar.knows(class_id)
        if not known:
            self.warn(f"no object for the class {class_id!r}")
        return known

    def keep(self, found: dict[int, Found], number: int, class_id: str, find: Callable[[], Found | None]) -> None:
        """Adds what ``find`` finds, or says why there is nothing."""
        try:
            one = find()
        except (ServiceError, TransformException, ValueError) as error:
            self.get_logger().error(f"{class_id}: {error}")
            return
        if one is None:
            self.get_logger().info(f"{class_id}: rejected, nothing is published")
        else:
            found[number] = one

    def box_in_map(self, detection: Detection3D, message: Detection3DArray) -> Box:
        """The detection's box in the map frame, at the detection's own time. Raises TransformException."""
        header = detection.header if detection.header.frame_id else message.header
        center, size = detection.bbox.center, detection.bbox.size
        box = Box(rigid(_quaternion(center.orientation), _vector(center.position)), _vector(size))
        if header.frame_id in ("", self.map_frame):
            return box
        return box.moved(self.to_map(header))

    def camera_in_map(self, header: Any) -> Matrix | None:
        """T_map_camera; None where no map is requested, or tf does not know it: the camera's frame is the world then.

        Raises TransformException where tf knows it, but not at the time of the image.
        """
        if not self.map_frame:
            return None
        if not self.transforms.can_transform(self.map_frame, header.frame_id, Time()):
            self.warn(
                f"tf has no transform from {header.frame_id!r} to {self.map_frame!r}: poses are in the camera frame"
            )
            return None
        return self.to_map(header)

    def to_map(self, header: Any) -> Matrix:
        """T_map_frame of a message's header, at its time."""
        time, patience = Time.from_msg(header.stamp), Duration(seconds=WAIT_S)
        moved = self.transforms.lookup_transform(self.map_frame, header.frame_id, time, patience).transform
        return rigid(_quaternion(moved.rotation), _vector(moved.translation))

    def publish(self, found: dict[int, Found], stamp: Any, frame: str) -> None:
        """found: by the numbers of their detections. An array without any is published too."""
        out = Detection3DArray()
        out.header.stamp, out.header.frame_id = stamp, frame
        for number, one in found.items():
            out.detections.append(self.detection_of(one, number, out))
            self.publish_pose(one, number, out)
        self.found_out.publish(out)

    def detection_of(self, found: Found, number: int, array: Detection3DArray) -> Detection3D:
        best = found.poses[0]
        out = Detection3D()
        out.header = array.header
        out.id = f"{found.class_id}/{number}/level={found.level or 'none'}/scale={best.scale:.6g}"
        for pose in found.poses:
            hypothesis = ObjectHypothesisWithPose()
            hypothesis.hypothesis.class_id = found.class_id
            hypothesis.hypothesis.score = float(found.probability)
            fill_pose(hypothesis.pose, pose)
            out.results.append(hypothesis)
        center, size = out.bbox.center, out.bbox.size
        center.position.x, center.position.y, center.position.z = found.box.T_frame_box[:3, 3].tolist()
        turn = center.orientation
        turn.x, turn.y, turn.z, turn.w = quaternion_xyzw(found.box.T_frame_box[:3, :3])
        size.x, size.y, size.z = found.box.size
        return out

    def publish_pose(self, found: Found, number: int, array: Detection3DArray) -> None:
        best = found.poses[0]
        stamped = PoseWithCovarianceStamped()
        stamped.header = array.header
        fill_pose(stamped.pose, best)
        self.pose_out.publish(stamped)
        frame = TransformStamped()
        frame.header = array.header
        frame.child_frame_id = f"regnf/{found.class_id}_{number}"
        translation, rotation = frame.transform.translation, frame.transform.rotation
        translation.x, translation.y, translation.z = best.position
        rotation.x, rotation.y, rotation.z, rotation.w = best.quaternion
        self.broadcaster.sendTransform(frame)


def best_class(detection: Detection3D) -> str | None:
    """The class of the most probable hypothesis; None where there is none."""
    hypotheses = [one.hypothesis for one in detection.results]
    return max(hypotheses, key=lambda one: one.score).class_id if hypotheses else None


def fill(pose, found: ObjectPose) -> None:
    """Write into a geometry_msgs/Pose."""
    pose.position.x, pose.position.y, pose.position.z = found.position
    orientation = pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = found.quaternion


def fill_pose(pose, found: ObjectPose) -> None:
    """Write into a geometry_msgs/PoseWithCovariance."""
    fill(pose.pose, found)
    pose.covariance = found.covariance.flatten().tolist()


def _vector(message) -> tuple[float, float, float]:
    return message.x, message.y, message.z


def _quaternion(message) -> tuple[float, float, float, float]:
    return message.x, message.y, message.z, message.w


def main() -> int:
    rclpy.init()
    try:
        node = RegisterObjects()
    except ValueError as error:
        get_logger("regnf").fatal(str(error))
        rclpy.try_shutdown()
        return 2
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)
    node.destroy_node()
    rclpy.try_shutdown()
    return 0
