"""The result of a registration, and its document, which the engine writes, the service returns and clients read.

A new member of the result is written here: in ``RegistrationResult``, in ``ResultDocument`` and in ``result_document``.
Torch-free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, WithJsonSchema

from regnf_core.errors import verdict_hint, verdict_in_words
from regnf_core.field_notes import FieldNotes
from regnf_core.options import Acceptance
from regnf_core.version import __version__

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from regnf_core.geometry.sim3 import Sim3
    from regnf_core.geometry.surface_samples import SurfaceSamples

Verdict = Literal["registered", "ambiguous", "rejected"]
Phase = Literal["loading", "sampling", "initializing", "optimizing", "verifying", "exporting"]

ProgressCallback = Callable[[Phase, float], None]
"""Called with the phase and the overall progress 0..1. May raise CancelledError to stop the work."""


class _Posed:
    """What has a T_object_scene."""

    T_object_scene: Sim3

    @property
    def T_scene_object(self) -> Sim3:
        """The object's pose in the scene."""
        return self.T_object_scene.inverse()


@dataclass(frozen=True)
class IterationRecord:
    """One iteration of the optimizer: the content of trace.json.

    residual_scene: mean |r| over the scene's samples, object units · residual_object: over the object's samples, scene
    units, as the paper has it.
    """

    iteration: int
    loss: float
    residual_scene: float
    residual_object: float
    regularizer: float
    kernel_shape: float
    kernel_scale: float
    scene_samples: int
    object_samples: int
    T_object_scene: Sim3


@dataclass(frozen=True)
class Alternative(_Posed):
    """Another pose that matches the data equally well, for example a symmetry equivalent."""

    T_object_scene: Sim3
    score: float
    relation: str


@dataclass(frozen=True)
class ConsideredPose(_Posed):
    """One pose that was refined, with its own verdict, without regard to other poses. reason, limit, level: as of a
    verdict."""

    T_object_scene: Sim3
    reason: str
    metrics: dict[str, float]
    limit: str = ""
    level: Acceptance | None = None


@dataclass(frozen=True, eq=False)
class Considered:
    """Candidate poses, the most probable first, and the evidence of the verification samples for each of the K poses.

    scene_points (N, 3), object_points (M, 3): the samples, each in its field's frame · scene_signs (K, N) uint8: 0 the
    object matches the scene's surface there, 1 it does not match although it is near, 2 it is not near · object_signs
    (K, M) uint8: 0 the scene confirms the object's surface there, 1 the scene has free space there, 2 nothing was
    observed there, 3 the surfaces differ by a little.
    """

    poses: list[ConsideredPose]
    scene_points: Tensor
    object_points: Tensor
    scene_signs: Tensor
    object_signs: Tensor


@dataclass(frozen=True)
class ObjectSymmetry:
    """The rotations that map the object onto itself. order: their number, including the identity.

    axis: unit vector, object frame: the common axis of all of them; None where there is none, as for a box's three half
    turns. With ``continuous`` every rotation about the axis is a symmetry, and ``order`` is 2 where the two ends of the
    axis look alike, else 1.
    """

    order: int
    axis: tuple[float, float, float] | None
    continuous: bool


@dataclass(frozen=True, eq=False)
class CameraView:
    """The camera of the image in which the detection was made. frame: its name · T_world_camera: its pose in the
    scene's frame, OpenCV's axes, scale 1 · object_unit: the object's unit in meters, if it is known."""

    frame: str
    T_world_camera: Sim3
    object_unit: float | None = None


SHOWN, ABSENT, UNKNOWN = range(3)
"""Evidence of the scene for a place of a candidate's surface: the surface is there, the place is free space, or it is
unclear, mostly because it was not observed."""


@dataclass(frozen=True, eq=False)
class DecidingSurface:
    """The surface of each of the first two candidates of a search that is not on the surface of the other one, at their
    poses.

    samples: (N,), scene frame · of_other (N,) bool: whose: False of the first, True of the other candidate · states
    (N,) uint8: SHOWN, ABSENT or UNKNOWN · distinguishable: as of the two's :class:`Difference`.
    """

    samples: SurfaceSamples
    of_other: Tensor
    states: Tensor
    distinguishable: bool


@dataclass(frozen=True, eq=False)
class RegistrationResult(_Posed):
    """The result of one registration. The object's pose in the scene is ``T_scene_object``.

    verdict_reason: one stable UPPER_SNAKE word, e.g. SURFACES_AGREE, LOW_OVERLAP · metrics: of the manual's list, and
    seconds by phase as seconds_<phase> · residuals: per point of both clouds: scene_points, scene_residuals,
    object_points, object_residuals; object units · center_object: (3,) float64, object frame: the centroid of the
    object's surface · verdict_limit: the limit that a rejected pose violates, as text, with both numbers; "" if there
    is none · alternatives: every distinct pose that matches the data equally well; empty unless ``ambiguous`` ·
    symmetry: the object's own, found by registering it with itself · considered: the candidate poses, for viewers ·
    surroundings: the scene's surface around the detection, for viewers · camera: the image that the detection was made
    in, where the scene is a recording · deciding: what tells the first two candidates of a search apart, where the
    first one is accepted and both were refined · level: the strictest named level of the option ``acceptance`` that the
    probability reaches; None: none.
    covariance: (7, 7) float64 of (omega_x, omega_y, omega_z, t_x, t_y, t_z, log_s): T_object_scene, x -> s R x + t,
    becomes s exp(log_s), exp([omega]) R, t + dt; radians and object units. The turn and the growth are about t, the
    place of the scene's origin: the farther that is from the object, the larger are the entries of t, however well the
    object's place is known. :func:`regnf_core.geometry.metrics.center_covariance` gives that.
    The preset `paper` gives no alternatives, covariance, symmetry and considered poses.
    """

    verdict: Verdict
    verdict_reason: str
    T_object_scene: Sim3
    T_object_scene_initial: Sim3
    scene_samples: SurfaceSamples
    object_samples: SurfaceSamples
    metrics: dict[str, float]
    trace: list[IterationRecord]
    residuals: dict[str, Tensor]
    seed: int
    options: dict[str, Any]
    center_object: Tensor
    verdict_limit: str = ""
    alternatives: list[Alternative] = field(default_factory=list)
    covariance: Tensor | None = None
    symmetry: ObjectSymmetry | None = None
    considered: Considered | None = None
    surroundings: SurfaceSamples | None = None
    camera: CameraView | None = None
    level: Acceptance | None = None
    deciding: DecidingSurface | None = None

    @property
    def T_camera_object(self) -> Sim3 | None:
        """The object's pose in the camera's frame (OpenCV's axes), of a scene that is a recording."""
        return None if self.camera is None else self.camera.T_world_camera.inverse() @ self.T_scene_object

    @property
    def center_scene(self) -> Tensor:
        """(3,) float64: the object's center in the scene frame."""
        return self.T_scene_object.apply(self.center_object[None])[0]

    @property
    def probability(self) -> float | None:
        """Probability, 0..1, that the pose or one of the alternatives is within 5 % of the object's diameter of the
        true pose or of a symmetry equivalent of it. It decides the verdict: see the option ``acceptance``. None with
        the preset `paper`."""
        return self.metrics.get("probability")


@dataclass(frozen=True)
class Difference:
    """Difference between the first candidate and another one: the part of each surface that is not on the other
    surface.

    differs: share of both surfaces that differs, 0..1 · seen: share of both surfaces that differs and was observed, as
    surface or as free space · favor: -1..1, the observed share that supports the first candidate minus the share that
    supports the other · distinguishable: whether enough of the difference was observed.
    """

    differs: float
    seen: float
    favor: float
    distinguishable: bool


@dataclass(frozen=True)
class Candidate:
    """The result of a search for one object.

    stage: the last stage that it reached · score: cost, 0..1, lower is better, comparable only within a stage. Verdict,
    reason, transform, probability and level are those of a registration, for ``refined`` objects; None for the others.
    difference: from the candidate that comes first, for other ``refined`` ones.
    """

    name: str
    stage: Literal["refined", "coarse", "signature"]
    score: float
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    T_object_scene: Sim3 | None = None
    probability: float | None = None
    level: Acceptance | None = None
    difference: Difference | None = None

    @property
    def T_scene_object(self) -> Sim3 | None:
        """The object's pose in the scene; None for the others."""
        return None if self.T_object_scene is None else self.T_object_scene.inverse()


def level_in_words(level: Acceptance | None) -> str:
    """The level as text, for a result with a probability."""
    return level or "below both levels"


def sure_in_words(probability: float | None, level: Acceptance | None) -> str:
    """Text after a verdict: `, probability 0.998 (strict)`; "" if there is no probability."""
    return "" if probability is None else f", probability {probability:.3f} ({level_in_words(level)})"


# The document: JSON values.

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Address = Annotated[str, WithJsonSchema({"type": "string", "format": "uri-reference"})]
"""An address on this service, without its host."""


class Outgoing(BaseModel):
    """Base of all documents of the service. Documents may gain members, so clients ignore unknown ones."""

    model_config = ConfigDict(frozen=True)


_Three = Annotated[list[float | None], Field(min_length=3, max_length=3)]
_Seven = Annotated[list[float | None], Field(min_length=7, max_length=7)]


class TransformDocument(Outgoing):
    """A similarity transform x -> s R x + t. `matrix` is the complete transform, row-major 4x4."""

    matrix: list[list[float]]
    scale: float
    rotation_quaternion_xyzw: list[float]
    translation: list[float]


class AlternativeDocument(Outgoing):
    """Another pose that fits the data equally well, for example of a symmetric table."""

    T_scene_object: TransformDocument
    T_object_scene: TransformDocument
    score: float = Field(description="Cost, 0..1, lower is better. The result's own cost is the metric `score`.")
    relation: str = Field(
        description="How it differs from the result, for example `180 degrees about z`. Axes are those of the object."
    )


class ConsideredDocument(Outgoing):
    """A pose that was refined and has its own verdict. `considered.npz` has the evidence of each sample."""

    T_scene_object: TransformDocument
    T_object_scene: TransformDocument
    reason: str = Field(description="Reason of the verdict: SURFACES_AGREE, or the reason against the pose.")
    detail: str = Field(default="", description="The reason as a sentence.")
    level: Acceptance | None = Field(
        default=None, description="The named level of `metrics.probability`, as in the result."
    )
    metrics: dict[str, float | None] = Field(default={})


class UncertaintyDocument(Outgoing):
    """Standard deviations from the covariance. They do not depend on the position of the scene's origin."""

    center_scene: _Three = Field(description="Of `center_scene` along the scene's x, y and z, scene units.")
    rotation_deg: _Three = Field(description="Of the rotation about the object frame's x, y and z, degrees.")
    scale_percent: float | None = Field(description="Of the scale, percent.")


class SymmetryDocument(Outgoing):
    """The rotations that map the object onto itself, found by registering it with itself."""

    order: int = Field(
        ge=1,
        description="Number of rotations, including the identity. With `continuous`: 1, or 2 if both ends of the "
        "axis look alike.",
    )
    axis: list[float] | None = Field(
        description="The axis of all rotations, a unit vector in the object frame; or null."
    )
    continuous: bool = Field(description="Whether every rotation about the axis is a symmetry.")


class DifferenceDocument(Outgoing):
    """Difference between a candidate and the first one: the part of each surface that is not on the other surface."""

    differs: float = Field(description="Share of both surfaces that differs between the two candidates, 0..1.")
    seen: float = Field(
        description="Share of both surfaces that differs and was observed, as surface or as free space."
    )
    favor: float = Field(
        description="-1..1: how much more observed surface supports the first candidate than this one."
    )
    distinguishable: bool = Field(description="Whether enough of the difference was observed to distinguish the two.")


class CandidateDocument(Outgoing):
    """The result of a search for one object of the library."""

    object: str = Field(description="SHA-256 of its field.")
    stage: Literal["refined", "coarse", "signature", "unusable"] = Field(
        description="The last stage that the candidate reached: refined on its field with a verdict, coarse "
        "search, comparison of signatures only; or unusable as an object."
    )
    score: float | None = Field(description="Cost, 0..1, lower is better. Compare it only within one stage.")
    verdict: Verdict | None = Field(default=None, description="Only for refined candidates.")
    verdict_reason: str | None = Field(default=None, description="Only for refined and unusable candidates.")
    probability: float | None = Field(
        default=None, description="Only for refined candidates. Same meaning as in the result."
    )
    level: Acceptance | None = Field(
        default=None, description="Only for refined candidates. Same meaning as in the result."
    )
    difference: DifferenceDocument | None = Field(
        default=None, description="Only for refined candidates after the first: the difference from the first."
    )
    T_scene_object: TransformDocument | None = Field(default=None, description="Only for refined candidates.")
    T_object_scene: TransformDocument | None = Field(default=None, description="Its inverse.")


class SettingsUsedDocument(Outgoing):
    """The trainer's settings that an import has used."""

    trainer: str | None = None
    files: list[str] = Field(default=[], description="Their names.")
    used: dict[str, Any] = Field(default={}, description="Import options, such as `hash.levels`, with their values.")


class FieldNotesDocument(Outgoing):
    """Notes of a field's import that are copied into a result."""

    family: str | None = Field(default=None, description="The format that was recognized.")
    settings: SettingsUsedDocument | None = Field(
        default=None, description="The trainer's settings that the import used."
    )
    warnings: list[str] = Field(
        default=[], description="Warnings of the import. Each begins with a stable word (docs/import-gate.md)."
    )
    assumed: list[str] = Field(
        default=[],
        description="What the file does not state and the import assumed. Each begins with `unit`, `axes`, `sign`, "
        "`order` or `cameras`.",
    )


class ArtifactEntry(Outgoing):
    """One file that the job has written or is writing."""

    name: str
    state: Literal["ready", "pending"] = Field(
        default="ready",
        description="`pending`: the file is still being made. A request for it waits until it is finished.",
    )
    bytes: int | None = Field(
        description="Size of the file. `bytes` and `sha256` are null while the file is pending, and for a picture "
        "before its first request."
    )
    sha256: Sha256 | None
    url: Address


class CameraDocument(Outgoing):
    """The object in the frame of the camera in whose image the detection was made: x right, y down, z forward."""

    frame: str = Field(description="The image's name.")
    T_camera_object: TransformDocument = Field(
        description="Object to camera coordinates. In meters if the scene is in meters."
    )
    T_scene_camera: TransformDocument = Field(description="Camera to scene coordinates; the scene is the recording.")
    center_camera: list[float] = Field(description="`center_object` in the camera frame, meters.")
    object_unit_m: float | None = Field(default=None, description="The object's unit in meters, if it is known.")


class ResultDocument(Outgoing):
    """The result of a registration. The name of a transform gives its direction."""

    verdict: Verdict
    verdict_reason: str = Field(description="Reason of the verdict: one stable word, for example SURFACES_AGREE.")
    verdict_detail: str = Field(default="", description="The reason as a sentence, with numbers.")
    verdict_hint: str = Field(default="", description="What the user can do next. Empty for a registered result.")
    probability: float | None = Field(
        default=None,
        description="Probability, 0..1, that the pose or one of the alternatives is within 5 % of the object's "
        "diameter of the true pose. It decides the verdict: see `options.robust.acceptance`. Null "
        "with the preset `paper`.",
    )
    level: Acceptance | None = Field(
        default=None,
        description="The strictest named level of `options.robust.acceptance` that the probability reaches. It "
        "does not depend on the level in the request. Null: none.",
    )
    T_scene_object: TransformDocument = Field(
        description="The object's pose in the scene: object to scene coordinates."
    )
    T_object_scene: TransformDocument = Field(description="Its inverse: scene coordinates to object coordinates.")
    center_scene: list[float] = Field(default=[], description="`center_object` in the scene frame.")
    center_object: list[float] = Field(default=[], description="The centroid of the object's surface, object frame.")
    T_object_scene_initial: TransformDocument | None = Field(
        default=None, description="The pose at the start of the refinement."
    )
    alternatives: list[AlternativeDocument] = Field(
        default=[],
        description="All other poses that fit the data equally well. Empty unless the verdict is `ambiguous`.",
    )
    considered: list[ConsideredDocument] | None = Field(
        default=None,
        description="Up to six candidate poses, each with its own verdict, the most probable first. Null with the "
        "preset `paper`.",
    )
    covariance: Annotated[list[_Seven], Field(min_length=7, max_length=7)] | None = Field(
        default=None,
        description="7x7 in the order of `covariance_ordering`, in radians and object units. A perturbation "
        "changes T_object_scene, x -> s R x + t, to s exp(log_s), exp([omega]) R, t + dt. Rotation "
        "and scaling are therefore about t, the image of the scene's origin; this is not exp(xi) "
        "T_object_scene. The object's point c is in the scene at p = R^T (c - t) / s. It moves by J "
        "(omega, dt, log_s) with J = R^T [[c - t]x, -I, -(c - t)] / s, so its covariance is J C J^T. "
        "docs/api.md has an example with numbers. Null with the preset `paper`.",
    )
    covariance_ordering: list[str] | None = Field(
        default=None, description="Order of rows and columns: omega (3), t (3), log_s."
    )
    uncertainty: UncertaintyDocument | None = None
    camera: CameraDocument | None = Field(
        default=None, description="The object in the camera frame, if the scene is a recording."
    )
    symmetry: SymmetryDocument | None = Field(
        default=None, description="The object's symmetry. Null with the preset `paper`."
    )
    metrics: dict[str, float | None] = Field(default={})
    object: str | None = Field(
        default=None, description="SHA-256 of the object's field. For a search, that of the most probable object."
    )
    candidates: list[CandidateDocument] | None = Field(
        default=None, description="The candidates of a search, the most probable first."
    )
    fields: dict[Literal["scene", "object"], FieldNotesDocument] | None = Field(
        default=None, description="Notes of the imports of scene and object."
    )
    seed: int = 0
    options: dict[str, Any] = Field(default={}, description="All options that were used, including defaults.")
    engine: dict[str, Any] = Field(default={}, description="Name, version, device.")
    artifacts: list[ArtifactEntry] = Field(default=[])
    missing_artifacts: list[str] = Field(default=[], description="Names of artifacts that could not be made.")


COVARIANCE_ORDERING = ("omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s")
"""What the rows and columns of a covariance belong to: see ``RegistrationResult.covariance``."""


def result_document(
    result: RegistrationResult,
    truth: Sim3 | None = None,
    device: torch.device | str = "cpu",
    *,
    object_name: str | None = None,
    candidates: list[dict[str, Any]] | None = None,
    fields: Mapping[str, FieldNotes] | None = None,
) -> dict[str, Any]:
    """Plain JSON values of the result; with ``truth``, a T_object_scene, the metrics have the errors relative to it.

    ``device``: of the computation.
    ``object_name``: the object that was registered. ``candidates``: of :func:`ranking_document`, after a search.
    ``fields``: notes of the imports of scene and object, by these names.
    """
    import torch

    from regnf_core.geometry.metrics import errors_against_truth, paper_errors, uncertainty

    metrics, center, T = dict(result.metrics), result.center_object, result.T_object_scene
    if truth is not None:
        metrics |= errors_against_truth(T, truth, result.object_samples.points, center)
        if result.options.get("preset") == "paper":
            metrics |= paper_errors(T, truth)
    document = ResultDocument(
        verdict=result.verdict,
        verdict_reason=result.verdict_reason,
        verdict_detail=verdict_in_words(result.verdict_reason, result.verdict_limit),
        verdict_hint=verdict_hint(result.verdict_reason, result.options),
        probability=None if result.probability is None else json_number(result.probability),
        level=result.level,
        **_both_ways(result),
        center_scene=result.center_scene.tolist(),
        center_object=center.tolist(),
        T_object_scene_initial=TransformDocument(**result.T_object_scene_initial.to_dict()),
        alternatives=[
            AlternativeDocument(**_both_ways(other), score=other.score, relation=other.relation)
            for other in result.alternatives
        ],
        metrics=_numbers(metrics),
        object=object_name,
        candidates=None if candidates is None else [CandidateDocument(**one) for one in candidates],
        seed=result.seed,
        options=result.options,
        engine={"name": "regnf", "version": __version__, "device": str(device), "torch": torch.__version__},
    ).model_dump(exclude={"artifacts", "missing_artifacts"})
    if result.considered is not None:
        document["considered"] = [_considered(one) for one in result.considered.poses]
    if result.covariance is not None:
        document["covariance"] = [[json_number(value) for value in row] for row in result.covariance.tolist()]
        document["covariance_ordering"] = list(COVARIANCE_ORDERING)
        document["uncertainty"] = uncertainty(result.covariance, T, center)
    if result.camera is not None and (pose := result.T_camera_object) is not None:
        document["camera"] = CameraDocument(
            frame=result.camera.frame,
            T_camera_object=TransformDocument(**pose.to_dict()),
            T_scene_camera=TransformDocument(**result.camera.T_world_camera.to_dict()),
            center_camera=pose.apply(center[None])[0].tolist(),
            object_unit_m=result.camera.object_unit,
        ).model_dump()
    if result.symmetry is not None:
        document["symmetry"] = SymmetryDocument(**asdict(result.symmetry)).model_dump()
    if fields is not None:
        document["fields"] = {role: fields[role].to_dict() for role in ("scene", "object") if role in fields}
    return document


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
            level=one.level,
            difference=None if one.difference is None else DifferenceDocument(**asdict(one.difference)),
            **_both_ways(one),
        )
        for one in ranking
    ]
    left_out = [
        CandidateDocument(object=name, stage="unusable", score=None, verdict_reason=reason)
        for name, reason in unusable.items()
    ]
    return [one.model_dump() for one in ranked + left_out]


def _considered(one: ConsideredPose) -> dict[str, Any]:
    detail = verdict_in_words(one.reason, one.limit)
    metrics = _numbers(one.metrics)
    found = ConsideredDocument(**_both_ways(one), reason=one.reason, detail=detail, level=one.level, metrics=metrics)
    return found.model_dump()


def _both_ways(pose: _Posed | Candidate) -> dict[str, Any]:
    there, back = pose.T_scene_object, pose.T_object_scene
    found = {"T_scene_object": there, "T_object_scene": back}
    return {name: None if T is None else TransformDocument(**T.to_dict()) for name, T in found.items()}


def _numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: json_number(value) for name, value in values.items()}


def json_number(value: float) -> float | None:
    """None for NaN and infinity, which JSON cannot hold."""
    return value if math.isfinite(value) else None
