"""The job id that follows from a registration request.

Two requests whose results are the same are one job: asking twice costs nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from regnf_core.engine_revision import ENGINE_REVISION
from regnf_state.records import FieldRecord
from regnf_state.registration_request import RegistrationRequest

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


def job_id_of(request: RegistrationRequest, functions: Mapping[str, str] | None = None) -> str:
    """The job's id: a digest of what the result depends on, the engine's revision and the fields' functions included.

    The webhook and the detection's label and score change nothing in a result, so they do not enter. The record of a
    job that exists keeps the label and score of the request that made it, and gets the webhook of each later one.
    """
    values = request.values()
    detection = {name: value for name, value in values["detection"].items() if name not in _WITHOUT_EFFECT}
    asked = {name: value for name, value in values.items() if name != "webhook"} | {"detection": detection}
    described = {"functions": dict(functions)} if functions else {}
    return digest({"kind": "registration", "engine": ENGINE_REVISION, "request": asked} | described)[:_ID_DIGITS]
