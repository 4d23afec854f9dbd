"""What a registration returns: the transform, how well it explains the data, and what is needed to look at it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples

Verdict = Literal["registered", "ambiguous", "rejected"]
Phase = Literal["loading", "sampling", "initializing", "optimizing", "verifying", "exporting"]

ProgressCallback = Callable[[Phase, float], None]
"""Called with the phase and the overall progress 0..1. May raise CancelledError to stop the work."""


@dataclass(frozen=True)
class IterationRecord:
    """One iteration of the optimizer: everything that trace.json shows."""

    iteration: int
    loss: float
    residual_scene: float
    """Mean |r| over the scene's samples, object units."""
    residual_object: float
    """Mean |r| over the object's samples, scene units, as the paper has it."""
    regularizer: float
    kernel_shape: float
    kernel_scale: float
    scene_samples: int
    object_samples: int
    T_object_scene: Sim3


@dataclass(frozen=True)
class Alternative:
    """Another pose that matches the data equally well, for example a symmetry equivalent."""

    T_object_scene: Sim3
    score: float
    relation: str

    @property
    def T_scene_object(self) -> Sim3:
        """The object's pose in the scene."""
        return self.T_object_scene.inverse()


@dataclass(frozen=True)
class ConsideredPose:
    """One pose that was refined and judged by itself, whatever rivals it has. reason, limit: as of a verdict."""

    T_object_scene: Sim3
    reason: str
    metrics: dict[str, float]
    limit: str = ""

    @property
    def T_scene_object(self) -> Sim3:
        """The object's pose in the scene."""
        return self.T_object_scene.inverse()


@dataclass(frozen=True, eq=False)
class Considered:
    """Poses that were judged, the likeliest first, and what the samples held out for that say of each of the K.

    scene_points (N, 3), object_points (M, 3): the samples, each in its field's frame · scene_signs (K, N) uint8: 0 the
    object explains the scene's surface there, 1 it does not although it is near, 2 it is not near · object_signs (K, M)
    uint8: 0 the scene confirms the object's surface there, 1 the scene is free there, 2 nothing was seen there, 3 the
    surfaces differ by a little.
    """

    poses: list[ConsideredPose]
    scene_points: Tensor
    object_points: Tensor
    scene_signs: Tensor
    object_signs: Tensor


@dataclass(frozen=True)
class ObjectSymmetry:
    """The rotations that map the object onto itself. order: how many there are, the identity included.

    axis: unit vector, object frame: the common axis of all of them; None where there is none, as for a box's three half
    turns. With ``continuous`` every rotation about the axis is a symmetry, and ``order`` is 2 where the two ends of the
    axis look alike, else 1.
    """

    order: int
    axis: tuple[float, float, float] | None
    continuous: bool


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """The outcome of one registration. The object's pose in the scene is ``T_scene_object``."""

    verdict: Verdict
    verdict_reason: str
    """One stable UPPER_SNAKE word, e.g. SURFACES_AGREE, LOW_OVERLAP."""
    T_object_scene: Sim3
    T_object_scene_initial: Sim3
    scene_samples: SurfaceSamples
    object_samples: SurfaceSamples
    metrics: dict[str, float]
    """residual_rms (object diameters, both directions), inlier_share_scene, inlier_share_object, iterations,
    field_evaluations, and seconds by phase as seconds_<phase>. The preset `robust` adds ``probability`` and more:
    the manual lists them all."""
    trace: list[IterationRecord]
    residuals: dict[str, Tensor]
    """Per point of both clouds: scene_points, scene_residuals, object_points, object_residuals; object units."""
    seed: int
    options: dict[str, Any]
    center_object: Tensor
    """(3,) float64, object frame: the centroid of the object's surface."""
    verdict_limit: str = ""
    """The limit that a rejected pose does not keep, in words, with both numbers; "" where there is none."""
    alternatives: list[Alternative] = field(default_factory=list)
    """The preset `robust` lists every distinct pose that matches the data equally well; empty unless ``ambiguous``."""
    covariance: Tensor | None = None
    """(7, 7) float64 of (omega_x, omega_y, omega_z, t_x, t_y, t_z, log_s): T_object_scene, x -> s R x + t, becomes
    s exp(log_s), exp([omega]) R, t + dt; radians and object units. The turn and the growth are about t, the place of
    the scene's origin: the farther that is from the object, the larger are the entries of t, however well the object's
    place is known. :func:`regnf_core.viewing.document.center_covariance` gives that. None from the preset
    `paper`."""
    symmetry: ObjectSymmetry | None = None
    """The object's own symmetries, found by registering it with itself. None from the preset `paper`."""
    considered: Considered | None = None
    """The poses that were judged, for viewers. None from the preset `paper`."""
    surroundings: SurfaceSamples | None = None
    """The scene's surface around the detection, for viewers."""

    @property
    def T_scene_object(self) -> Sim3:
        """The object's pose in the scene."""
        return self.T_object_scene.inverse()

    @property
    def center_scene(self) -> Tensor:
        """(3,) float64, scene frame: where the object's center is."""
        return self.T_scene_object.apply(self.center_object[None])[0]

    @property
    def probability(self) -> float | None:
        """That the answer is right, 0..1: that the pose, or one of the alternatives that place nearly the same surface,
        is within 5 % of the object's diameter, or equal to that by the object's symmetry. What the option
        ``min_probability`` is compared with. None from the preset `paper`."""
        return self.metrics.get("probability")


# Progress reports and the seconds of each phase, the same for every preset.

STARTS: dict[Phase, float] = {
    "sampling": 0.0,
    "initializing": 0.15,
    "optimizing": 0.2,
    "verifying": 0.95,
    "exporting": 0.98,
}
"""The overall share done when each phase begins."""


class Run:
    """Progress reports and the seconds of each phase."""

    def __init__(self, progress: ProgressCallback | None) -> None:
        self.seconds: dict[str, float] = {}
        self._done = 0.0
        self._progress = progress

    def report(self, phase: Phase, done: float) -> None:
        """Report a phase and the overall share done (0..1). The share never falls: a second attempt repeats earlier
        phases."""
        self._done = max(self._done, min(done, 1.0))
        if self._progress is not None:
            self._progress(phase, self._done)

    def finish(
        self, result: RegistrationResult, add_clouds: Callable[[RegistrationResult], RegistrationResult] | None = None
    ) -> RegistrationResult:
        """The result with its clouds, if any are wanted, and with the seconds of all phases among its metrics."""
        if add_clouds is not None:
            with self.phase("exporting"):
                result = add_clouds(result)
        self.report("exporting", 1.0)
        result.metrics.update(self.seconds)
        return result

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        self.report(name, STARTS[name])
        start = time.perf_counter()
        yield
        key = f"seconds_{name}"
        self.seconds[key] = self.seconds.get(key, 0.0) + time.perf_counter() - start
