"""From a checked request to a job: fields looked up, boxes compared with the scene, the job recorded and queued."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from regnf_core.cost import Cost, Term, estimate
from regnf_core.detections import Bounds, Detection, require_in_scene
from regnf_core.errors import InvalidDetectionError
from regnf_core.options import RegistrationOptions
from regnf_core.rendering import request as rendering_cost
from regnf_core.rendering.request import RENDERER_REVISION, RenderRequest
from regnf_core.version import ENGINE_REVISION
from regnf_service.problem import Problem, json_pointer
from regnf_service.services import Services
from regnf_state.ownership import ANONYMOUS, owner_of, reference_of
from regnf_state.records import FieldRecord, JobRecord, RecordError
from regnf_state.registration_request import JobRequest, RenderingRequest, estimated_cost, kind_of
from regnf_state.settings import Settings

# Requests that multiply to more memory, time or files than one job may have are refused before they are queued.

DEFAULT_MEMORY_BYTES = 4 << 30
"""The most that a request may be estimated at where REGNF_JOB_MEMORY_BYTES says nothing else."""
_SECONDS_ARE_WITHIN = 10.0
"""Fields differ in speed by this factor either way: what the fastest ones would do in time is taken."""
_GIB = 1 << 30


def check_cost(settings: Settings, request: JobRequest) -> None:
    """Raises Problem OPTIONS_TOO_COSTLY, or RENDER_TOO_LARGE for a rendering.

    What default options cost is never refused, however low the limits are.
    """
    cost = estimated_cost(request)
    if isinstance(request, RenderingRequest):
        _check_files(settings, request)
        _check(settings, cost, rendering_cost.estimate(RenderRequest()), "RENDER_TOO_LARGE")
    else:
        usual = estimate(RegistrationOptions(preset=request.options.preset), max(1, len(request.objects)))
        _check(settings, cost, usual, "OPTIONS_TOO_COSTLY")


def _check(settings: Settings, cost: Cost, usual: Cost, reason: str) -> None:
    memory = max(settings.job_memory_bytes or DEFAULT_MEMORY_BYTES, usual.memory_bytes)
    if cost.memory_bytes > memory:
        estimated, limit = f"{cost.memory_bytes / _GIB:.1f} GiB of memory", f"{memory / _GIB:.1f} GiB"
        raise _refusal(cost.largest("memory_bytes"), estimated, limit, reason)
    seconds = max(settings.job_timeout_s, usual.seconds)
    least = cost.seconds / _SECONDS_ARE_WITHIN
    if least > seconds:
        raise _refusal(cost.largest("seconds"), f"at least {least:,.0f} s", f"{seconds:,.0f} s", reason)


def _check_files(settings: Settings, request: RenderingRequest) -> None:
    files, limit = rendering_cost.estimate(request.rendering).file_bytes, settings.job_scratch_bytes
    if files > limit:
        detail = f"The files may need {files / _GIB:.1f} GiB; the limit is {limit / _GIB:.1f} GiB."
        fault = {"pointer": "/outputs", "detail": detail}
        hint = "Request fewer or smaller frames, or fewer outputs."
        raise Problem("RENDER_TOO_LARGE", detail, errors=[fault], hint=hint)


def _refusal(term: Term, estimated: str, limit: str, reason: str) -> Problem:
    detail = f"The job would need an estimated {estimated}; the limit is {limit}. Most of it is for {_count(term)}."
    within = ("options",) if reason == "OPTIONS_TOO_COSTLY" else ()
    fault = f"{_count(term)}: {estimated}, limit {limit}"
    errors = [{"pointer": json_pointer((*within, *option)), "detail": fault} for option in term.options]
    return Problem(reason, detail, errors=errors)


def _count(term: Term) -> str:
    return f"{term.count:,} {term.counts}"


# The job id that follows from a request.
#
# Two requests whose results are the same are one job: asking twice costs nothing.

_ID_DIGITS = 32
_WITHOUT_EFFECT = frozenset({"label", "score"})
"""Members of a detection that no result depends on."""
_IN_IMAGE = frozenset({"mask", "box_2d", "point_2d"})
_SHOWN_IMAGES = 8


def digest(value: Any) -> str:
    """SHA-256, lower-case hexadecimal, of a JSON value in canonical spelling."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def functions_of(fields: Iterable[FieldRecord | None]) -> dict[str, str]:
    """What was said of each field of which anything was: the same bytes with another description are another field."""
    return {field.sha256: digest(field.description) for field in fields if field is not None and field.description}


def job_id_of(request: JobRequest, functions: Mapping[str, str] | None = None) -> str:
    """The job's id: a digest of what the result depends on, the engine's revision and the fields' functions included.

    The webhook and a detection's label and score change nothing in a result, so they do not enter. The record of a
    job that exists keeps the label and score of the request that made it, and gets the webhook of each later one.
    """
    asked = {name: _of_effect(value) for name, value in request.values().items() if name != "webhook"}
    revisions: dict[str, Any] = {"engine": ENGINE_REVISION}
    if isinstance(request, RenderingRequest):
        revisions["renderer"] = RENDERER_REVISION
    described = {"functions": dict(functions)} if functions else {}
    return digest({"kind": kind_of(request), **revisions, "request": asked} | described)[:_ID_DIGITS]


def _of_effect(value: Any) -> Any:
    """A request's value without what has no effect in the detections in it."""
    if isinstance(value, list):
        return [_of_effect(one) for one in value]
    if not isinstance(value, dict):
        return value
    is_detection = "rotation_quaternion_xyzw" in value or not value.keys().isdisjoint(_IN_IMAGE)
    without = _WITHOUT_EFFECT if is_detection else frozenset()
    return {name: _of_effect(one) for name, one in value.items() if name not in without}


_KEY_LIFETIME_S = 24 * 3600
_MAX_KEY_LENGTH = 255


def check_idempotency_key(key: str | None) -> None:
    """Raises Problem INVALID_HEADER."""
    if key is not None and not (0 < len(key) <= _MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        raise Problem("INVALID_HEADER", "`Idempotency-Key` has 1 to 255 characters of printable ASCII.")


class FieldLookup:
    """Records of fields for several requests of a caller: what they name is read in one round trip, each once."""

    def __init__(self, services: Services, caller: str) -> None:
        self._records = services.records
        self._caller = caller
        self._held: dict[str, FieldRecord | None] = {}

    def read(self, names: Iterable[str]) -> None:
        """Read these fields, by their SHA-256s, unless the call before has; forget all others."""
        held = self._held
        references = dict.fromkeys(reference_of(self._caller, name) for name in names)
        new = [reference for reference in references if reference not in held]
        found = dict(zip(new, self._records.get_fields(new) if new else (), strict=True))
        self._held = {one: held[one] if one in held else found[one] for one in references}

    def get(self, name: str) -> FieldRecord | None:
        return self._held[reference_of(self._caller, name)]


def check_fields(
    services: Services,
    caller: str,
    request: JobRequest,
    named: Mapping[str, str],
    fields: FieldLookup | None = None,
) -> None:
    """Refuse what can be refused now; a field that is still validating is waited for by the worker.

    ``named`` are the fields that the caller must have, by where the request names them, a JSON Pointer. ``fields``:
    where these and the scene were read.
    Raises Problem OPTIONS_TOO_COSTLY, RENDER_TOO_LARGE, FIELD_NOT_FOUND, FIELD_REJECTED, DETECTION_OUTSIDE_SCENE,
    RECORDING_UNSUITABLE, IMAGE_DETECTION_WITHOUT_RECORDING, WEBHOOK_NOT_ALLOWED.
    """
    check_cost(services.settings, request)
    services.webhooks.check(caller, request.webhook)
    if fields is None:
        fields = FieldLookup(services, caller)
        fields.read([request.scene, *named.values()])
    records = {pointer: fields.get(name) for pointer, name in named.items()}
    _require_usable(records)
    scene = fields.get(request.scene)
    _require_suited(request, scene, records)
    bounds = _bounds(scene)
    if bounds is None:
        return
    for pointer, box in _boxes(request).items():
        try:
            require_in_scene(box, bounds, _bounds(records.get("/object")))
        except InvalidDetectionError as error:
            fault = {"pointer": pointer, "detail": str(error)}
            raise Problem(error.reason, str(error), errors=[fault], hint=error.hint) from error


def _boxes(request: JobRequest) -> dict[str, Detection]:
    if not isinstance(request, RenderingRequest):
        return {"/detection": request.detection} if isinstance(request.detection, Detection) else {}
    named = {f"/edits/{n}/detection": getattr(one, "detection", None) for n, one in enumerate(request.rendering.edits)}
    if request.rendering.orbit is not None:
        named["/orbit/detection"] = request.rendering.orbit.detection
    return {pointer: box for pointer, box in named.items() if box is not None}


def _require_usable(found: Mapping[str, FieldRecord | None]) -> None:
    missing = [{"pointer": pointer, "detail": "no such field"} for pointer, record in found.items() if record is None]
    if missing:
        raise Problem("FIELD_NOT_FOUND", errors=missing)
    rejected = [
        {"pointer": pointer, "detail": f"rejected: {(record.error or {}).get('reason', 'unknown')}"}
        for pointer, record in found.items()
        if record is not None and record.state == "rejected"
    ]
    if rejected:
        raise Problem("FIELD_REJECTED", errors=rejected)


def _require_suited(request: JobRequest, scene: FieldRecord | None, named: Mapping[str, FieldRecord | None]) -> None:
    """A recording is a scene to register in, and only there are detections in images."""
    is_scene_only = not isinstance(request, RenderingRequest)
    used = {pointer: record for pointer, record in named.items() if pointer != "/scene"}
    used |= {} if is_scene_only else {"/scene": scene}
    wrong = [pointer for pointer, record in used.items() if record is not None and record.is_recording]
    if wrong:
        raise Problem("RECORDING_UNSUITABLE", errors=[{"pointer": one, "detail": "a recording"} for one in wrong])
    if scene is not None and not scene.is_recording:
        require_box(request)


def require_box(request: JobRequest) -> None:
    """Of a scene that is a field. Raises Problem IMAGE_DETECTION_WITHOUT_RECORDING."""
    if not isinstance(request, RenderingRequest) and not isinstance(request.detection, Detection):
        fault = {"pointer": "/detection", "detail": "in an image, but the scene is a field"}
        raise Problem("IMAGE_DETECTION_WITHOUT_RECORDING", errors=[fault])


def _bounds(found: FieldRecord | None) -> Bounds | None:
    match found.report.get("bounds") if found is not None else None:
        case [[_, _, _] as lower, [_, _, _] as upper]:
            return lower, upper
        case {"min": [_, _, _] as lower, "max": [_, _, _] as upper}:
            return lower, upper
    return None


def future_job_id(services: Services, caller: str, asked: JobRequest, fields: FieldLookup | None = None) -> str:
    """The id of the job for a caller's request, by what its fields are now, or were when ``fields`` was read."""
    names = [asked.scene, *asked.objects]
    if fields is None:
        fields = FieldLookup(services, caller)
        fields.read(names)
    return job_id_of(asked.owned_by(caller), functions_of(map(fields.get, names)))


def submit(services: Services, caller: str, asked: JobRequest, idempotency_key: str | None) -> JobRecord:
    """The job for a caller's request: a new one, or the one that exists, queued if it has not run.

    A job that exists tells the request's webhook of its end too; one that has finished, at once.
    Raises Problem IDEMPOTENCY_KEY_REUSED, QueueFullError, QuotaError, RecordsFullError.
    """
    request = asked.owned_by(caller)
    job_id = future_job_id(services, caller, asked)
    services.room.make(caller)
    if idempotency_key is not None:
        key = idempotency_key if caller == ANONYMOUS else [caller, idempotency_key]
        existing = _earlier_answer(services, digest(key), job_id, request)
        if existing is not None:
            return existing
    (started,) = start(services, caller, [(job_id, asked)])
    if isinstance(started, RecordError):
        raise started
    return started


def start(
    services: Services, caller: str, asked: Sequence[tuple[str, JobRequest]], batch: str | None = None
) -> list[JobRecord | RecordError]:
    """The same once there is room, for jobs whose ids are known, with the refusal in the place of one that is refused.

    All of them are recorded together, then queued. batch: the id of the batch that starts them.
    """
    now = services.records.now()
    new = [
        JobRecord(
            id=job_id,
            kind=kind_of(one),
            status="accepted",
            request=one.owned_by(caller).to_record(),
            inputs=_inputs(one) | ({} if batch is None else {"batch": batch}),
            created=now,
            updated=now,
        )
        for job_id, one in asked
    ]
    answers = services.records.create_jobs(new, services.settings.max_queued_jobs, services.quota)
    started = [answer if isinstance(answer, RecordError) else answer[0] for answer in answers]
    # also jobs known before: mends one that was recorded but never queued
    services.queue.enqueue_jobs([job for job in started if isinstance(job, JobRecord) and job.status == "accepted"])
    return started


def _earlier_answer(services: Services, key: str, job_id: str, request: JobRequest) -> JobRecord | None:
    """The job that an earlier call with this key made: its answer was lost on its way, and nothing is started twice."""
    asked = digest(request.values())  # of all of it: another webhook is another request
    mine = f"{asked} {services.records.now()!r}"
    bound = services.records.set_if_absent(f"idempotency:{key}", mine, _KEY_LIFETIME_S, owner_of(request.scene))
    bound_request, _, bound_at_text = bound.partition(" ")
    try:
        bound_at = float(bound_at_text)
    except ValueError:
        return None  # damaged: nothing is done twice, for the job's id follows from the request
    if bound_request != asked:
        raise Problem("IDEMPOTENCY_KEY_REUSED")
    known = services.records.get_job(job_id) if bound != mine else None
    # a job that has not changed since the key came up is not that call's doing: the call never got so far
    if known is None or known.updated < bound_at:
        return None
    return known if request.webhook is None or request.webhook in known.webhooks else None


def _shown(detection: Any) -> Any:
    """A detection as the job's record shows it for as long as it is kept: without masks."""
    if not isinstance(detection, list):
        return detection
    return [one | ({"mask": True} if "mask" in one else {}) for one in detection[:_SHOWN_IMAGES]]


def _inputs(request: JobRequest) -> dict[str, Any]:
    values = request.values()
    if isinstance(request, RenderingRequest):
        return {
            "scene": request.scene,
            "edits": [one.kind for one in request.rendering.edits],
            "frames": request.rendering.frames,
            "size": list(request.rendering.image_size),
            "mode": request.rendering.options.mode,
            "outputs": list(request.rendering.outputs),
            "seed": request.rendering.seed,
            "options_sha256": digest(values["options"]),
        }
    return {
        "scene": request.scene,
        "object": request.object,
        "candidates": None if request.candidates is None else len(request.candidates),
        "detection": _shown(values["detection"]),
        "seed": request.seed,
        "initial_transform": request.initial_transform,
        "pictures": request.pictures,
        "options_sha256": digest(values["options"]),
    }
