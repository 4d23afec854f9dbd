"""The one form of each registration request, and the job id that follows from it.

Two requests whose results are the same are one job: asking twice costs nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_service.http.schemas.registrations import RegistrationSpec
from regnf_service.http.schemas.transforms import rows_of
from regnf_state.registration_request import RegistrationRequest, recorded_detection

_ID_DIGITS = 32
_WITHOUT_EFFECT = frozenset({"label", "score"})
"""Members of a detection that no result depends on."""


def canonical_request(
    spec: RegistrationSpec, scene: str, object_: str | None, candidates: Sequence[str] | None = None
) -> RegistrationRequest:
    """What a worker reads from the job record: every default filled in, every spelling of a value made one.

    The order of candidates says nothing, so they are sorted.
    """
    start, truth, webhook = spec.initial_transform, spec.ground_truth, spec.webhook
    return RegistrationRequest(
        scene=scene,
        object=object_,
        candidates=None if candidates is None else tuple(sorted(candidates)),
        detection=recorded_detection(spec.detection.canonical()),
        options=spec.options,
        seed=spec.seed,
        initial_transform=None if start is None else rows_of(start),
        ground_truth=None if truth is None else rows_of(truth.T_object_scene),
        webhook=None if webhook is None else webhook.url,
    )


def digest(value: Any) -> str:
    """SHA-256, lower-case hexadecimal, of a JSON value in canonical spelling."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def job_id_of(request: RegistrationRequest) -> str:
    """The job's id: a digest of what the result depends on, the engine's revision included.

    The webhook and the detection's label and score change nothing in a result, so they do not enter. The record of a
    job that exists keeps the label and score of the request that made it, and gets the webhook of each later one.
    """
    values = request.values()
    detection = {name: value for name, value in values["detection"].items() if name not in _WITHOUT_EFFECT}
    asked = {name: value for name, value in values.items() if name != "webhook"} | {"detection": detection}
    return digest({"kind": "registration", "engine": ENGINE_REVISION, "request": asked})[:_ID_DIGITS]
