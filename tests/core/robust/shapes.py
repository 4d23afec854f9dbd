"""Shapes, rooms and frames that the tests of the robust preset share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from regnf_core.document import RegistrationResult
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import CountingField, Observation, ObservedField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.options import RegistrationOptions
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from tests.core.analytic import AnalyticField, boxes, chair, chair_box, chair_pose, room, seen_from, union

ROBUST = RegistrationOptions(preset="robust")
ONE_SEARCH = RegistrationOptions.from_dict({"robust": {"feature_draws": 0}})
"""Where an answer is rejected, no second search is made for another."""


def detection() -> OrientedBox:
    """The box of the room's chair in the pose ``chair_pose()``."""
    return chair_box(chair_pose())


def random_pose(seed: int, scale: float) -> Sim3:
    """Any orientation, a shift of about one unit, the given scale."""
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    return Sim3.from_quaternion(scale, quaternion, shift)


def slab_table() -> AnalyticField:
    """A rectangular table with one slab and two broad feet: half a turn about z carries it onto itself."""
    return boxes(
        [
            ([-0.45, -0.3, 0.1], [0.45, 0.3, 0.16]),
            ([-0.40, -0.25, -0.3], [-0.30, 0.25, 0.1]),
            ([0.30, -0.25, -0.3], [0.40, 0.25, 0.1]),
        ]
    )


def table_room(T_object_scene: Sim3) -> AnalyticField:
    """The slab table on a floor, and a wall."""
    floor = boxes([([-1.0, -1.0, -0.06], [1.0, 1.0, 0.0]), ([-1.0, 0.9, 0.0], [1.0, 1.0, 0.8])])
    return union([floor, seen_from(slab_table(), T_object_scene)])


def can() -> AnalyticField:
    """An upright cylinder with a narrower neck on top: every turn about z carries it onto itself, nothing else does."""

    def formula(points: Tensor) -> Tensor:
        radial = points[:, :2].square().sum(-1).add(1e-12).sqrt()
        parts = []
        for radius, low, high in ((0.3, -0.4, 0.2), (0.15, 0.1, 0.4)):
            q = torch.stack([radial - radius, (points[:, 2] - (low + high) / 2).abs() - (high - low) / 2])
            parts.append(q.clamp_min(0).square().sum(0).add(1e-20).sqrt() + q.amax(0).clamp_max(0))
        return torch.stack(parts).amin(0)

    return AnalyticField(formula, [[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])


def can_room() -> AnalyticField:
    """The can standing on a floor, 0.6 of its size."""
    T_object_scene = Sim3.from_quaternion(1.0 / 0.6, [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -0.41])
    floor = boxes([([-1.0, -1.0, -0.06], [1.0, 1.0, 0.0])])
    return union([floor, seen_from(can(), T_object_scene)])


def reframed(scene_pose: Sim3, object_pose: Sim3) -> tuple[TransformedField, TransformedField, OrientedBox, Sim3]:
    """The room and the chair, each seen in another frame, with the box and the true T_object_scene there.

    The poses carry the old frames into the new ones.
    """
    old = detection()
    box = OrientedBox(
        scene_pose.apply(old.center[None])[0], old.size * scene_pose.scale, scene_pose.rotation @ old.rotation
    )
    scene = TransformedField(room(chair_pose()), scene_pose.inverse())
    obj = TransformedField(chair(), object_pose.inverse())
    return scene, obj, box, object_pose @ chair_pose() @ scene_pose.inverse()


def placement_error(result: RegistrationResult, truth: Sim3) -> float:
    """Largest distance between true and estimated place of the object's samples, object diameters."""
    return pose_distance(result.T_object_scene, truth, result)


def pose_distance(T: Sim3, truth: Sim3, result: RegistrationResult) -> float:
    points = result.object_samples.points.double()
    apart = (T.inverse().apply(points) - truth.inverse().apply(points)).norm(dim=-1).max()
    return float(apart * truth.scale) / result.metrics["object_diameter"]


def run(
    scene: object, obj: object, box: OrientedBox, options: RegistrationOptions = ROBUST, seed: int = 0
) -> RegistrationResult:
    return register(scene, obj, box, options, seed=seed, clouds=False)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Alone:
    """A registration of one pair without clouds, and how often its fields were evaluated."""

    result: RegistrationResult
    of_scene: int
    of_object: int


@cache
def alone(obj: Callable[[], AnalyticField] = chair, options: RegistrationOptions = ROBUST) -> Alone:
    """Of the room's chair or another object in its place, with seed 0; tests share it."""
    scene, field = CountingField(room(chair_pose())), CountingField(obj())
    result = run(scene, field, detection(), options)
    return Alone(result, scene.evaluations, field.evaluations)


# The room with its chair, of which all was observed but one part of the chair.

UNDER_THE_SEAT = ([-0.26, -0.27, -0.41], [0.26, 0.27, -0.03])
CUSHION = ([-0.20, -0.20, 0.02], [0.16, 0.14, 0.12])
OBSERVED_VOXEL = 0.02


def over_closed(part: tuple[list[float], list[float]]) -> AnalyticField:
    """The room, with more matter in ``part`` of the chair, its frame."""
    return union([room(chair_pose()), seen_from(boxes([part]), chair_pose())])


def observed(scene: AnalyticField, part: tuple[list[float], list[float]]) -> ObservedField:
    """Of ``scene`` everything was seen but ``part`` of the chair, its frame."""
    low, high = scene.bounds
    counts = ((high - low) / OBSERVED_VOXEL).round().long().tolist()
    axes = [low[k] + (torch.arange(counts[k]) + 0.5) * OBSERVED_VOXEL for k in range(3)]
    centers = torch.cartesian_prod(*axes)
    value = scene.signed_distance(centers)
    states = torch.where(value.abs() < 0.9 * OBSERVED_VOXEL, SURFACE, torch.where(value > 0, FREE, UNSEEN))
    hidden = seen_from(boxes([part]), chair_pose()).signed_distance(centers) < 0.9 * OBSERVED_VOXEL
    states[hidden] = UNSEEN
    return ObservedField(scene, Observation(states.to(torch.uint8).view(counts), low, OBSERVED_VOXEL))
