"""A job's events in Redis: a stream, read by XREAD."""

from __future__ import annotations

import json
from typing import Any

from regnf_state import transitions
from regnf_state.records import JobEvent
from regnf_state.redis.documents import is_wrong_type, text


def start_of(after: str | None) -> str:
    """Where XREAD begins. Raises ValueError when ``after`` is no event id."""
    return "{}-{}".format(*transitions.parse_event_id(after)) if after is not None else "0-0"


def events_in(answer: Any) -> list[JobEvent]:
    """The events in an answer to XREAD about one stream, in either protocol's shape; none where it is no stream."""
    if is_wrong_type(answer):
        return []
    if isinstance(answer, Exception):
        raise answer
    chunks = (
        [chunk for chunks in answer.values() for chunk in chunks]
        if isinstance(answer, dict)
        else [chunk for _, chunk in answer or []]
    )
    return [_event(entry) for chunk in chunks for entry in chunk]


def _event(entry: tuple[bytes | str, dict[bytes | str, bytes | str]]) -> JobEvent:
    identifier, fields = entry
    values = {text(name): text(value) for name, value in fields.items()}
    return JobEvent(text(identifier), values["name"], json.loads(values["data"]))
