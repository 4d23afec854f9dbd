"""From a detection to what is published: which object is requested, what an answer means. No ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.linalg import inv

from regnf_ros.images import CameraImage, Seen, Size
from regnf_ros.parameters import options_of
from regnf_ros.poses import Box, Matrix, ObjectPose, object_pose
from regnf_ros.service import Request, Service, ServiceError


@dataclass(frozen=True)
class Asked:
    """What is the same for all registrations.

    scene: the SHA-256 of the room's field, "" where images are the scene · objects: the SHA-256 of each class' field ·
    up_axis, scale_tolerance, object_unit: as of the parameters.
    """

    scene: str
    objects: dict[str, str]
    T_field_map: Matrix
    up_axis: str = ""
    scale_tolerance: float | None = None
    object_unit: str = "auto"

    def options(self, T_scene_map: Matrix, upright: bool = True) -> dict[str, Any]:
        """upright: whether the scene's axes are those of the map."""
        up_axis = self.up_axis if upright else ""
        return options_of(up_axis, self.scale_tolerance, self.object_unit, T_scene_map)


@dataclass(frozen=True)
class Found:
    """What is published of one detection. poses: the best first, then those that agree as well.

    box: that of the detection, or around the object where an image was searched, in the frame of the answer; of size 0
    where the object's bounds are not known · probability: that one of the poses is right · level: the strictest
    named one that it reaches; None: none.
    """

    class_id: str
    poses: list[ObjectPose]
    box: Box
    probability: float
    level: str | None


class Registrar:
    """Registers boxes of the map frame against one scene, and what is seen in images of a camera."""

    def __init__(self, service: Service, asked: Asked) -> None:
        self._service = service
        self._asked = asked
        self._bounds: dict[str, list[list[float]] | None] = {}

    def knows(self, class_id: str) -> bool:
        return class_id in self._asked.objects

    def find(self, class_id: str, box_in_map: Box) -> Found | None:
        """The object in the box; None for a rejected pose. Raises ServiceError, ValueError without a scene."""
        asked, T_field_map = self._asked, self._asked.T_field_map
        if not asked.scene:
            raise ValueError("a box in space needs the parameter scene, the SHA-256 of the room's field")
        detection = box_in_map.moved(T_field_map).detection()
        result = self._register(Request(asked.scene, asked.objects[class_id], detection, asked.options(T_field_map)))
        return None if result is None else _found(class_id, result, box_in_map, T_field_map)

    def find_in_image(self, seen: Seen, image: CameraImage, size: Size) -> Found | None:
        """The object of a 2D detection, in the frame that ``image`` has its camera's pose in; None for a rejected pose.

        size: of the image that detections are made in, where they do not say it. Raises ServiceError, ValueError.
        """
        object_, upright = self._asked.objects[seen.class_id], image.T_map_camera is not None
        options = self._asked.options(np.eye(4), upright)
        result = self._register(Request(image, object_, seen.detection(image.size, size), options))
        if result is None:
            return None
        T_scene_camera = _matrix(result["camera"]["T_scene_camera"])
        T_scene_frame = T_scene_camera if image.T_map_camera is None else T_scene_camera @ inv(image.T_map_camera)
        return _found(seen.class_id, result, self._box(object_, result, T_scene_frame), T_scene_frame)

    def forget(self) -> None:
        """Nothing more is searched for in the images so far: the service need not keep them."""
        self._service.forget()

    def _register(self, request: Request) -> dict[str, Any] | None:
        result = self._service.register(request)
        return None if result["verdict"] == "rejected" else result

    def _box(self, object_: str, result: dict[str, Any], T_scene_frame: Matrix) -> Box:
        """The box of the object's own axes around it."""
        if self._bounds.get(object_) is None:
            try:
                self._bounds[object_] = self._service.bounds(object_)
            except ServiceError:  # the pose is known all the same
                self._bounds[object_] = None
        given = self._bounds[object_]
        low, high = np.zeros((2, 3)) if given is None else np.asarray(given, dtype=np.float64)
        middle = np.asarray(result["center_object"]) if given is None else (low + high) / 2.0
        box = Box(np.eye(4), tuple((high - low).tolist()))
        box.T_frame_box[:3, 3] = middle
        return box.moved(inv(_matrix(result["T_object_scene"]) @ T_scene_frame))


def _found(class_id: str, result: dict[str, Any], box: Box, T_field_map: Matrix) -> Found:
    def pose(said: dict[str, Any], covariance: Matrix | None) -> ObjectPose:
        return object_pose(_matrix(said["T_object_scene"]), covariance, T_field_map)

    given = result.get("covariance")
    best = pose(result, None if given is None else np.asarray(given, dtype=np.float64))
    others = [pose(one, None) for one in result.get("alternatives", [])]
    return Found(class_id, [best, *others], box, result["probability"], result["level"])


def _matrix(said: dict[str, Any]) -> Matrix:
    return np.asarray(said["matrix"], dtype=np.float64)
