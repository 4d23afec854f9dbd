"""From a box and a class to what is published: which object is asked for, what an answer means. No ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_ros.poses import Box, Matrix, ObjectPose, object_pose
from regnf_ros.service import Request, Service


@dataclass(frozen=True)
class Found:
    """What is published of one box. poses: the best first, then those that agree as well.

    box: that of the detection, in the map frame · probability: that one of the poses is right.
    """

    class_id: str
    poses: list[ObjectPose]
    box: Box
    probability: float
    verdict: str


class Registrar:
    """Registers boxes of the map frame against one scene."""

    def __init__(
        self, service: Service, scene: str, objects: dict[str, str], T_field_map: Matrix, options: dict[str, Any]
    ) -> None:
        self._service = service
        self._scene = scene
        self._objects = objects
        self._T_field_map = T_field_map
        self._options = options

    def knows(self, class_id: str) -> bool:
        return class_id in self._objects

    def find(self, class_id: str, box_in_map: Box) -> Found | None:
        """The object in the box; None for a rejected pose. Raises ServiceError."""
        detection = box_in_map.moved(self._T_field_map).detection()
        result = self._service.register(Request(self._scene, self._objects[class_id], detection, self._options))
        if result["verdict"] == "rejected":
            return None
        given = result.get("covariance")
        covariance = None if given is None else np.asarray(given, dtype=np.float64)
        best = self._pose(result, covariance)
        others = [self._pose(one, None) for one in result.get("alternatives", [])]
        return Found(class_id, [best, *others], box_in_map, result["probability"], result["verdict"])

    def _pose(self, said: dict[str, Any], covariance: Matrix | None) -> ObjectPose:
        matrix = np.asarray(said["T_object_scene"]["matrix"], dtype=np.float64)
        return object_pose(matrix, covariance, self._T_field_map)
