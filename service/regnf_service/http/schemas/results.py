"""What a registration found, as the contract shows it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from regnf_service.http.schemas.common import Address, Outgoing, Sha256

Verdict = Literal["registered", "ambiguous", "rejected"]
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
    detail: str = Field("", description="The same in words.")
    metrics: dict[str, float | None] = Field({})


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
    verdict: Verdict | None = Field(None, description="Of refined ones.")
    verdict_reason: str | None = Field(None, description="Of refined and unusable ones.")
    probability: float | None = Field(None, description="Of refined ones, as the result's.")
    T_scene_object: TransformDocument | None = Field(None, description="Of refined ones.")
    T_object_scene: TransformDocument | None = Field(None, description="Its inverse.")


class SettingsUsedDocument(Outgoing):
    """Which of a trainer's settings an import has used."""

    trainer: str | None = None
    files: list[str] = Field([], description="Their names.")
    used: dict[str, Any] = Field({}, description="Entries of a description, such as `hash.levels`, and their values.")


class FieldNotesDocument(Outgoing):
    """What the import of a field said that a result repeats."""

    family: str | None = Field(None, description="The format that was recognized.")
    settings: SettingsUsedDocument | None = Field(None, description="The trainer's settings that counted.")
    warnings: list[str] = Field([], description="Each begins with a stable word and a colon: docs/import-gate.md.")


class ArtifactEntry(Outgoing):
    """One file that the job wrote, or is about to write."""

    name: str
    state: Literal["ready", "pending"] = Field(
        "ready", description="`pending`: it is still being made; a request for it is held until it is there."
    )
    bytes: int | None = Field(description="Null while it is pending, as the digest.")
    sha256: Sha256 | None
    url: Address


class ResultDocument(Outgoing):
    """What a registration found. Transforms carry their direction in their name."""

    verdict: Verdict
    verdict_reason: str = Field(description="One stable word, e.g. SURFACES_AGREE.")
    verdict_detail: str = Field(
        "", description="The reason in words, for people, with the number and the limit that it does not keep."
    )
    verdict_hint: str = Field("", description="What to do next, for people; empty for a registered result.")
    probability: float | None = Field(
        None,
        description="0..1: that the pose, or one of the alternatives that place nearly the same surface, is right, "
        "within 5 % of the object's diameter. No answer below `options.robust.min_probability` is accepted. "
        "Null from the preset `paper`.",
    )
    T_scene_object: TransformDocument = Field(
        description="The object's pose in the scene: object coordinates to scene coordinates."
    )
    T_object_scene: TransformDocument = Field(description="Its inverse: scene coordinates to object coordinates.")
    center_scene: list[float] = Field(
        [], description="Where the object's center is, scene frame: T_scene_object of `center_object`."
    )
    center_object: list[float] = Field([], description="The centroid of the object's surface, object frame.")
    T_object_scene_initial: TransformDocument | None = Field(None, description="Where the refinement began.")
    alternatives: list[AlternativeDocument] = Field(
        [], description="Every other pose that explains the data as well; empty unless `ambiguous`."
    )
    considered: list[ConsideredDocument] | None = Field(
        None, description="Up to six poses that were judged, the likeliest first; null from the preset `paper`."
    )
    covariance: Annotated[list[_Seven], Field(min_length=7, max_length=7)] | None = Field(
        None,
        description="7x7 in the order of `covariance_ordering`, in radians and object units. T_object_scene, "
        "x -> s R x + t, becomes s exp(log_s), exp([omega]) R, t + dt, so turn and growth are about t, where the "
        "scene's origin lies; it is not exp(xi) T_object_scene. The object's point c lies in the scene at "
        "p = R^T (c - t) / s and moves by J (omega, dt, log_s) with J = R^T [[c - t]x, -I, -(c - t)] / s: its "
        "covariance is J C J^T. docs/api.md has an example in numbers. Null from the preset `paper`.",
    )
    covariance_ordering: list[str] | None = Field(None, description="omega_x, omega_y, omega_z, t_x, t_y, t_z, log_s.")
    uncertainty: UncertaintyDocument | None = None
    symmetry: SymmetryDocument | None = Field(None, description="The object's own; null from the preset `paper`.")
    metrics: dict[str, float | None] = Field({})
    object: str | None = Field(None, description="SHA-256 of the object's field; of a search, of the likeliest's.")
    candidates: list[CandidateDocument] | None = Field(
        None, description="All candidates of a search, the likeliest first; null for one object."
    )
    fields: dict[Literal["scene", "object"], FieldNotesDocument] | None = Field(
        None, description="What is known of the imports of scene and object."
    )
    seed: int = 0
    options: dict[str, Any] = Field({}, description="Every option that was used, defaults included.")
    engine: dict[str, Any] = Field({}, description="Name, version, device.")
    artifacts: list[ArtifactEntry] = Field([])
    missing_artifacts: list[str] = Field(
        [], description="Names of pictures and clouds that could not be made once the result was out."
    )
