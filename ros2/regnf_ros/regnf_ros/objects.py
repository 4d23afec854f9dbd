"""From a box and a class to what is published: which object is asked for, what an answer means. No ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_ros.poses import Box, Matrix, ObjectPose, object_pose, scale_of
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


def objects_of(text: str) -> dict[str, str]:
    """``chair=SHA table=SHA`` as a table. Raises ValueError for an entry that is none, or a class that comes twice."""
    table: dict[str, str] = {}
    for entry in text.split():
        name, sign, digest = entry.partition("=")
        if not (name and sign and digest) or name in table:
            raise ValueError(f"objects: {entry!r} is not CLASS=SHA256, or names its class again")
        table[name] = digest
    return table


def options_of(up_axis: str, scale_tolerance: str, T_field_map: Matrix) -> dict[str, Any]:
    """The options of every registration. scale_tolerance: by what share the objects' units may differ from meters; "":
    they are not known. Raises ValueError for one that is no share."""
    options: dict[str, Any] = {"up_axis": up_axis} if up_axis else {}
    if scale_tolerance:
        share = float(scale_tolerance)
        if not 0.0 <= share < 1.0:
            raise ValueError(f"scale_tolerance: {scale_tolerance!r} is not at least 0 and less than 1")
        metric = 1.0 / scale_of(T_field_map)
        options["robust"] = {"min_scale": (1.0 - share) * metric, "max_scale": (1.0 + share) * metric}
    return options


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
