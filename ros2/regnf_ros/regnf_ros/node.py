"""The node: boxes in, poses out. Topics and frames: docs/how-to/robot.md of regnf."""

from __future__ import annotations

from contextlib import suppress
from queue import Full, Queue
from threading import Thread

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

from regnf_ros.objects import Found, Registrar
from regnf_ros.parameters import axis_of, objects_of, options_of, share_of, text_of, token_of
from regnf_ros.poses import Box, ObjectPose, field_from_map, quaternion_xyzw, rigid
from regnf_ros.service import Service, ServiceError

TEXTS = ("server", "token_file", "scene", "map_frame", "dataparser_transforms")
PARAMETERS = (*TEXTS, "objects", "up_axis", "scale_tolerance")
DEFAULTS = {"server": "http://127.0.0.1:8080", "map_frame": "map"}
WAITING = 16
"""Arrays of detections that may wait for the service; later ones are dropped, which is said in the log."""


class RegisterObjects(Node):
    """Registers each detection and publishes what is found. A thread of its own talks to the service."""

    def __init__(self) -> None:
        super().__init__("regnf")
        # of any type: YAML makes a boolean of `up_axis: y`, and a parameter of one type would end the node there
        any_type = ParameterDescriptor(dynamic_typing=True)
        given = {name: self.declare_parameter(name, DEFAULTS.get(name, ""), any_type).value for name in PARAMETERS}
        said = {name: text_of(name, given[name]) for name in TEXTS}
        self.map_frame = said["map_frame"]
        T_field_map = field_from_map(said["dataparser_transforms"])
        self.registrar = Registrar(
            Service(said["server"], token_of(said["token_file"])),
            said["scene"],
            objects_of(given["objects"]),
            T_field_map,
            options_of(
                axis_of("up_axis", given["up_axis"]),
                share_of("scale_tolerance", given["scale_tolerance"]),
                T_field_map,
            ),
        )
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)
        self.broadcaster = TransformBroadcaster(self)
        self.found_out = self.create_publisher(Detection3DArray, "objects", 10)
        self.pose_out = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.waiting: Queue[Detection3DArray] = Queue(WAITING)
        self.create_subscription(Detection3DArray, "detections", self.take, 10)
        Thread(target=self.work, daemon=True).start()

    def take(self, message: Detection3DArray) -> None:
        """Called by the executor: never waits."""
        try:
            self.waiting.put_nowait(message)
        except Full:
            self.get_logger().warning("the service is slower than the detections: one array was dropped")

    def work(self) -> None:
        while True:
            self.answer(self.waiting.get())

    def answer(self, message: Detection3DArray) -> None:
        """Registers all detections of a message and publishes what was found."""
        out = Detection3DArray()
        out.header.stamp, out.header.frame_id = message.header.stamp, self.map_frame
        for number, detection in enumerate(message.detections):
            found = self.register(detection, message)
            if found is None:
                continue
            out.detections.append(self.detection_of(found, number, out))
            self.publish_pose(found, number, out)
        self.found_out.publish(out)

    def register(self, detection: Detection3D, message: Detection3DArray) -> Found | None:
        class_id = best_class(detection)
        if class_id is None or not self.registrar.knows(class_id):
            self.get_logger().warning(f"no object for the class {class_id!r}")
            return None
        try:
            box = self.box_in_map(detection, message)
            found = self.registrar.find(class_id, box)
        except (ServiceError, TransformException, ValueError) as error:
            self.get_logger().error(f"{class_id}: {error}")
            return None
        if found is None:
            self.get_logger().info(f"{class_id}: rejected, nothing is published")
        return found

    def box_in_map(self, detection: Detection3D, message: Detection3DArray) -> Box:
        """The detection's box in the map frame, at the detection's own time. Raises TransformException."""
        header = detection.header if detection.header.frame_id else message.header
        center, size = detection.bbox.center, detection.bbox.size
        box = Box(rigid(_quaternion(center.orientation), _vector(center.position)), _vector(size))
        if header.frame_id in ("", self.map_frame):
            return box
        stamped = self.transforms.lookup_transform(self.map_frame, header.frame_id, Time.from_msg(header.stamp))
        moved = stamped.transform
        return box.moved(rigid(_quaternion(moved.rotation), _vector(moved.translation)))

    def detection_of(self, found: Found, number: int, array: Detection3DArray) -> Detection3D:
        best = found.poses[0]
        out = Detection3D()
        out.header = array.header
        out.id = f"{found.class_id}/{number}/scale={best.scale:.6g}"
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
    """The class of the likeliest hypothesis; None where there is none."""
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
