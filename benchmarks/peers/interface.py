"""What a method is given, what it gives back, and what it must offer."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

from benchmarks.robust.cases import Case
from benchmarks.symmetric_errors import Symmetries
from regnf_core import OrientedBox, SdfField, Sim3
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import SamplingOptions
from regnf_core.paper.sampling import sample_object, sample_scene


class MissingPackageError(RuntimeError):
    """A method needs an optional package that is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(f"package {package} is not installed")
        self.package = package


@dataclass(frozen=True, eq=False)
class PeerCase:
    """One registration, the same for every method.

    scene_samples, object_samples: surface points and normals, each in its field's frame and units, taken once by
    regnf's sampler; sampling_seconds and sampling_evaluations say what that took.
    truth: T_object_scene. A method may only read it for what it is said to be given (keypoints, a start).
    diameter: of the object, object units.
    """

    name: str
    scene: SdfField
    obj: SdfField
    detection: OrientedBox
    truth: Sim3
    symmetries: Symmetries
    diameter: float
    scene_samples: SurfaceSamples
    object_samples: SurfaceSamples
    sampling_seconds: float
    sampling_evaluations: int


@dataclass(frozen=True, eq=False)
class PeerResult:
    """What a method found.

    T_object_scene: scene coordinates to object coordinates; None when the method gives no pose.
    seconds, field_evaluations: the method's own, without the shared sampling. note: what a reader should know.
    """

    T_object_scene: Sim3 | None
    seconds: float
    field_evaluations: int = 0
    note: str = ""


class Peer(Protocol):
    """A registration method.

    given: what it is told beyond the shared points and the box, in words, for the table.
    uses_samples: whether it starts from the shared surface points, whose cost then counts as its own.
    """

    name: str
    given: str
    uses_samples: bool

    def register(self, case: PeerCase, seed: int) -> PeerResult:
        """The pose that the method finds. Deterministic for a seed where the method's package allows it.

        Raises RegnfError where it ends without a result.
        """
        ...


def sampled(case: Case, diameter: float) -> PeerCase:
    """The case with its surface points, by the published multi-view sampling (five views) of both fields.

    Raises ValueError for a case without truth, NoSurfaceError and InvalidDetectionError as the sampler does.
    """
    if case.truth is None:
        raise ValueError(f"{case.name} has no true pose: nothing to compare with")
    scene, obj = CountingField(case.scene), CountingField(case.obj)
    begun = time.perf_counter()
    options = SamplingOptions()
    scene_samples = sample_scene(scene, case.detection, options)
    object_samples = sample_object(obj, options)
    return PeerCase(
        name=case.name,
        scene=case.scene,
        obj=case.obj,
        detection=case.detection,
        truth=case.truth,
        symmetries=case.symmetries,
        diameter=diameter,
        scene_samples=scene_samples,
        object_samples=object_samples,
        sampling_seconds=time.perf_counter() - begun,
        sampling_evaluations=scene.evaluations + obj.evaluations,
    )
