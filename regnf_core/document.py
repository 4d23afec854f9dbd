"""What a registration returns, and the document of it that the engine writes, the service answers and clients read.

A new member of the result is written here: in ``RegistrationResult``, in ``ResultDocument`` and in ``result_document``.
Torch-free.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, WithJsonSchema

from regnf_core.errors import verdict_hint, verdict_in_words
from regnf_core.field_notes import FieldNotes
from regnf_core.version import __version__

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from regnf_core.geometry.metrics import Symmetries
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
    place is known. :func:`regnf_core.geometry.metrics.center_covariance` gives that. None from the preset
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


@dataclass(frozen=True)
class Candidate:
    """What a search tells about one object.

    stage: the last stage that it reached · score: 0..1, smaller is better, comparable only within a stage. Verdict,
    reason, transform and probability are those of a registration, for ``refined`` objects; None for the others.
    """

    name: str
    stage: Literal["refined", "coarse", "signature"]
    score: float
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    T_object_scene: Sim3 | None = None
    probability: float | None = None

    @property
    def T_scene_object(self) -> Sim3 | None:
        """The object's pose in the scene; None for the others."""
        return None if self.T_object_scene is None else self.T_object_scene.inverse()


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


# The document: JSON values.

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Address = Annotated[str, WithJsonSchema({"type": "string", "format": "uri-reference"})]
"""An address on this service, without its host."""


class Outgoing(BaseModel):
    """Base of what the service sends; it may gain members, so clients ignore those they do not know."""

    model_config = ConfigDict(frozen=True)


_Three = Annotated[list[float | None], Field(min_length=3, max_length=3)]
_Seven = Annotated[list[float | None], Field(min_length=7, max_length=7)]


class TransformDocument(Outgoing):
    """A similarity transform x -> s R x + t. `matrix` is row-major 4x4 and holds all of it."""

    matrix: list[list[float]]
    scale: float
    rotation_quaternion_xyzw: list[float]
    translation: list[float]


class AlternativeDocument(Outgoing):
    """Another pose that explains the data as well, such as a table's twin."""

    T_scene_object: TransformDocument
    T_object_scene: TransformDocument
    score: float = Field(description="0..1, smaller is better; the result's own is the metric `score`.")
    relation: str = Field(description="How it differs from the result, such as `180 degrees about z`: object axes.")


class ConsideredDocument(Outgoing):
    """A pose that was refined and judged by itself. `considered.npz` has what each sample says of it."""

    T_scene_object: TransformDocument
    T_object_scene: TransformDocument
    reason: str = Field(description="As of a verdict: SURFACES_AGREE, or what speaks against it.")
    detail: str = Field(default="", description="The same in words.")
    metrics: dict[str, float | None] = Field(default={})


class UncertaintyDocument(Outgoing):
    """One standard deviation each, from the covariance. They do not depend on where the scene's origin is."""

    center_scene: _Three = Field(description="Of `center_scene`, along the scene's x, y, z, scene units.")
    rotation_deg: _Three = Field(description="Degrees about the object frame's x, y, z.")
    scale_percent: float | None = Field(description="Of the scale.")


class SymmetryDocument(Outgoing):
    """The turns that carry the object onto itself, found by registering it with itself."""

    order: int = Field(
        ge=1, description="How many, the identity included; with `continuous`, how many ends look alike: 1 or 2."
    )
    axis: list[float] | None = Field(description="Unit vector, object frame, that all of them turn about; or null.")
    continuous: bool = Field(description="Whether every turn about the axis is one.")


class CandidateDocument(Outgoing):
    """What a search found out about one object of a library."""

    object: str = Field(description="SHA-256 of its field.")
    stage: Literal["refined", "coarse", "signature", "unusable"] = Field(
        description="How far it came: refined on its field and judged, searched coarsely, compared by signature alone; "
        "or unusable as an object."
    )
    score: float | None = Field(description="0..1, smaller is better; to be compared within one stage.")
    verdict: Verdict | None = Field(default=None, description="Of refined ones.")
    verdict_reason: str | None = Field(default=None, description="Of refined and unusable ones.")
    probability: float | None = Field(default=None, description="Of refined ones, as the result's.")
    T_scene_object: TransformDocument | None = Field(default=None, description="Of refined ones.")
    T_object_scene: TransformDocument | None = Field(default=None, description="Its inverse.")


class SettingsUsedDocument(Outgoing):
    """Which of a trainer's settings an import has used."""

    trainer: str | None = None
    files: list[str] = Field(default=[], description="Their names.")
    used: dict[str, Any] = Field(
        default={}, description="Entries of a description, such as `hash.levels`, and their values."
    )


class FieldNotesDocument(Outgoing):
    """What the import of a field said that a result repeats."""

    family: str | None = Field(default=None, description="The format that was recognized.")
    settings: SettingsUsedDocument | None = Field(default=None, description="The trainer's settings that counted.")
    warnings: list[str] = Field(
        default=[], description="Each begins with a stable word and a colon: docs/import-gate.md."
    )


class ArtifactEntry(Outgoing):
    """One file that the job wrote, or is about to write."""

    name: str
    state: Literal["ready", "pending"] = Field(
        default="ready", description="`pending`: it is still being made; a request for it is held until it is there."
    )
    bytes: int | None = Field(description="Null while it is pending, as the digest.")
    sha256: Sha256 | None
    url: Address


class ResultDocument(Outgoing):
    """What a registration found. Transforms carry their direction in their name."""

    verdict: Verdict
    verdict_reason: str = Field(description="One stable word, e.g. SURFACES_AGREE.")
    verdict_detail: str = Field(
        default="", description="The reason in words, for people, with the number and the limit that it does not keep."
    )
    verdict_hint: str = Field(default="", description="What to do next, for people; empty for a registered result.")
    probability: float | None = Field(
        default=None,
        description="0..1: that the pose, or one of the alternatives that place nearly the same surface, is right, "
        "within 5 % of the object's diameter. No answer below `options.robust.min_probability` is accepted. "
        "Null from the preset `paper`.",
    )
    T_scene_object: TransformDocument = Field(
        description="The object's pose in the scene: object coordinates to scene coordinates."
    )
    T_object_scene: TransformDocument = Field(description="Its inverse: scene coordinates to object coordinates.")
    center_scene: list[float] = Field(
        default=[], description="Where the object's center is, scene frame: T_scene_object of `center_object`."
    )
    center_object: list[float] = Field(default=[], description="The centroid of the object's surface, object frame.")
    T_object_scene_initial: TransformDocument | None = Field(default=None, description="Where the refinement began.")
    alternatives: list[AlternativeDocument] = Field(
        default=[], description="Every other pose that explains the data as well; empty unless `ambiguous`."
    )
    considered: list[ConsideredDocument] | None = Field(
        default=None, description="Up to six poses that were judged, the likeliest first; null from the preset `paper`."
    )
    covariance: Annotated[list[_Seven], Field(min_length=7, max_length=7)] | None = Field(
        default=None,
        description="7x7 in the order of `covariance_ordering`, in radians and object units. T_object_scene, "
        "x -> s R x + t, becomes s exp(log_s), exp([omega]) R, t + dt, so turn and growth are about t, where the "
        "scene's origin lies; it is not exp(xi) T_object_scene. The object's point c lies in the scene at "
        "p = R^T (c - t) / s and moves by J (omega, dt, log_s) with J = R^T [[c - t]x, -I, -(c - t)] / s: its "
        "covariance is J C J^T. docs/api.md has an example in numbers. Null from the preset `paper`.",
    )
    covariance_ordering: list[str] | None = Field(
        default=None, description="omega_x, omega_y, omega_z, t_x, t_y, t_z, log_s."
    )
    uncertainty: UncertaintyDocument | None = None
    symmetry: SymmetryDocument | None = Field(
        default=None, description="The object's own; null from the preset `paper`."
    )
    metrics: dict[str, float | None] = Field(default={})
    object: str | None = Field(
        default=None, description="SHA-256 of the object's field; of a search, of the likeliest's."
    )
    candidates: list[CandidateDocument] | None = Field(
        default=None, description="All candidates of a search, the likeliest first; null for one object."
    )
    fields: dict[Literal["scene", "object"], FieldNotesDocument] | None = Field(
        default=None, description="What is known of the imports of scene and object."
    )
    seed: int = 0
    options: dict[str, Any] = Field(default={}, description="Every option that was used, defaults included.")
    engine: dict[str, Any] = Field(default={}, description="Name, version, device.")
    artifacts: list[ArtifactEntry] = Field(default=[])
    missing_artifacts: list[str] = Field(
        default=[], description="Names of pictures and clouds that could not be made once the result was out."
    )


COVARIANCE_ORDERING = ("omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s")
"""What the rows and columns of a covariance belong to: see ``RegistrationResult.covariance``."""
_ROLES: tuple[Literal["scene", "object"], ...] = ("scene", "object")


def result_document(
    result: RegistrationResult,
    truth: Sim3 | None = None,
    symmetries: Symmetries | None = None,
    device: torch.device | str = "cpu",
    *,
    object_name: str | None = None,
    candidates: list[dict[str, Any]] | None = None,
    fields: Mapping[str, FieldNotes] | None = None,
) -> dict[str, Any]:
    """Plain JSON values of the result; with ``truth``, a T_object_scene, the metrics hold the errors against it.

    ``symmetries`` are the object's: rotation error and MSSD are the smallest over them. ``device``: of the computation.
    ``object_name``: the object that was registered. ``candidates``: of :func:`ranking_document`, after a search.
    ``fields``: what is known of the imports of scene and object, by these names.
    """
    import torch

    from regnf_core.geometry.metrics import errors_against_truth, paper_errors, uncertainty

    metrics = dict(result.metrics)
    if truth is not None:
        metrics |= errors_against_truth(
            result.T_object_scene, truth, result.object_samples.points, symmetries, result.center_object
        )
        if result.options.get("preset") == "paper":
            metrics |= paper_errors(result.T_object_scene, truth)
    covariance, symmetry = result.covariance, result.symmetry
    document = ResultDocument(
        verdict=result.verdict,
        verdict_reason=result.verdict_reason,
        verdict_detail=verdict_in_words(result.verdict_reason, result.verdict_limit),
        verdict_hint=verdict_hint(result.verdict_reason, result.options),
        probability=None if result.probability is None else json_number(result.probability),
        T_scene_object=_transform(result.T_scene_object),
        T_object_scene=_transform(result.T_object_scene),
        center_scene=result.center_scene.tolist(),
        center_object=result.center_object.tolist(),
        T_object_scene_initial=_transform(result.T_object_scene_initial),
        alternatives=[
            AlternativeDocument(**_both_ways(other), score=other.score, relation=other.relation)
            for other in result.alternatives
        ],
        considered=None if result.considered is None else [_considered(one) for one in result.considered.poses],
        covariance=None if covariance is None else [[json_number(v) for v in row] for row in covariance.tolist()],
        covariance_ordering=None if covariance is None else list(COVARIANCE_ORDERING),
        uncertainty=None
        if covariance is None
        else UncertaintyDocument(**uncertainty(covariance, result.T_object_scene, result.center_object)),
        symmetry=None if symmetry is None else SymmetryDocument(**asdict(symmetry)),
        metrics={name: json_number(value) for name, value in metrics.items()},
        object=object_name,
        candidates=None if candidates is None else [CandidateDocument(**one) for one in candidates],
        fields=None
        if fields is None
        else {role: FieldNotesDocument(**fields[role].to_dict()) for role in _ROLES if role in fields},
        seed=result.seed,
        options=result.options,
        engine={"name": "regnf", "version": __version__, "device": str(device), "torch": torch.__version__},
    )
    return document.model_dump(exclude={"artifacts", "missing_artifacts"})


def ranking_document(ranking: Sequence[Candidate], unusable: Mapping[str, str]) -> list[dict[str, Any]]:
    """A search's candidates as plain values, the best first, then those ``unusable``: their names and reasons."""
    ranked = [
        CandidateDocument(
            object=one.name,
            stage=one.stage,
            score=json_number(one.score),
            verdict=one.verdict,
            verdict_reason=one.verdict_reason,
            probability=one.probability,
            T_scene_object=None if one.T_scene_object is None else _transform(one.T_scene_object),
            T_object_scene=None if one.T_object_scene is None else _transform(one.T_object_scene),
        )
        for one in ranking
    ]
    left_out = [
        CandidateDocument(object=name, stage="unusable", score=None, verdict_reason=reason)
        for name, reason in unusable.items()
    ]
    return [one.model_dump() for one in ranked + left_out]


def _considered(one: ConsideredPose) -> ConsideredDocument:
    return ConsideredDocument(
        **_both_ways(one),
        reason=one.reason,
        detail=verdict_in_words(one.reason, one.limit),
        metrics={name: json_number(value) for name, value in one.metrics.items()},
    )


def _both_ways(pose: Alternative | ConsideredPose) -> dict[str, Any]:
    return {"T_scene_object": _transform(pose.T_scene_object), "T_object_scene": _transform(pose.T_object_scene)}


def _transform(T: Sim3) -> TransformDocument:
    return TransformDocument(**T.to_dict())


def json_number(value: float) -> float | None:
    """None for NaN and infinity, which JSON cannot hold."""
    return value if math.isfinite(value) else None
