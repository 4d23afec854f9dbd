"""The job id that follows from a request.

Two requests whose results are the same are one job: asking twice costs nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_core.rendering.revision import RENDERER_REVISION
from regnf_state.job_request import JobRequest, kind_of
from regnf_state.records import FieldRecord
from regnf_state.rendering_request import RenderingRequest

_ID_DIGITS = 32
_WITHOUT_EFFECT = frozenset({"label", "score"})
"""Members of a detection that no result depends on."""


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
    without = _WITHOUT_EFFECT if "rotation_quaternion_xyzw" in value else frozenset()
    return {name: _of_effect(one) for name, one in value.items() if name not in without}
