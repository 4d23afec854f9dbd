"""What a registration found, as the contract shows it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, WithJsonSchema

from regnf_core.library_entries import LABEL_PATTERN
from regnf_state.reasons import whole_problem

# Pieces that several schemas share.

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Moment = Annotated[str, WithJsonSchema({"type": "string", "format": "date-time"})]
"""A time as ``rfc3339`` writes it."""
Address = Annotated[str, WithJsonSchema({"type": "string", "format": "uri-reference"})]
"""An address on this service, without its host."""
Links = dict[str, Address]
Label = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=LABEL_PATTERN)]


class Incoming(BaseModel):
    """Base of what clients send: unknown members and values of another type are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Outgoing(BaseModel):
    """Base of what the service sends; it may gain members, so clients ignore those they do not know."""

    model_config = ConfigDict(frozen=True)


class ProblemEntry(Outgoing):
    """One fault: a JSON Pointer into the body, or the name of a query parameter or header."""

    pointer: str | None = None
    parameter: str | None = None
    detail: str


class ReadingDocument(Outgoing):
    """One of several functions that an upload may be."""

    name: str
    description: dict[str, Any] = Field(description="The entries that choose it: send them with PATCH.")
    picture: Address | None = Field(None, description="Its picture, for as long as the upload is kept.")


class ProblemDocument(Outgoing):
    """RFC 9457 problem details. Programs switch on `reason`, never on text."""

    type: Address
    title: str
    status: Annotated[int, Field(ge=400, le=599)]
    reason: str
    detail: str
    hint: str | None = Field(None, description="What to do next, for people.")
    instance: str | None = None
    request_id: str | None = None
    errors: list[ProblemEntry] = []
    candidates: list[ReadingDocument] = Field(
        [], description="With a field's `LAYOUT_AMBIGUOUS`: what it may be, the likeliest first."
    )
    error: ProblemDocument | None = Field(None, description="With `JOB_FAILED`: the job's own problem.")
    offset: int | None = Field(None, description="Of an upload in pieces: how many bytes have arrived.")


def outgoing_problem(error: dict[str, Any] | None) -> dict[str, Any] | None:
    """A record's problem as it travels."""
    return None if error is None else whole_problem(error)


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


# What the service says about itself.


class HealthDocument(Outgoing):
    """The process answers."""

    status: Literal["ok"]


class ReadyDocument(Outgoing):
    """Every part the service needs is there."""

    status: Literal["ready"]
    checks: dict[str, bool]


class VersionDocument(Outgoing):
    """What runs here."""

    name: Literal["regnf"]
    version: str
    python: str


class IndexDocument(Outgoing):
    """Every address, each with what it is for."""

    name: Literal["regnf"]
    version: str
    addresses: dict[str, str]


class DemoFile(Outgoing):
    """A field file to fetch and to upload."""

    name: str
    bytes: int
    address: str


class DemoDocument(Outgoing):
    """A scene and an object to try, and a detection as `POST /register` takes it."""

    scene: DemoFile
    object: DemoFile
    detection: dict[str, Any]
