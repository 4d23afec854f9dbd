"""A refusal, as RFC 9457 has it: raised anywhere in the service, answered in one place (regnf_service.http.problems).

It tells a stable reason, a sentence, and JSON Pointers. It never repeats an input.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from regnf_state.reasons import REASONS, problem_document

RETRY_LATER = {"Retry-After": "5"}
MAX_ERRORS = 32
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


class Problem(Exception):  # noqa: N818 -- RFC 9457's own word
    """An answer that refuses. ``reason`` must be in REASONS; it gives status and title."""

    def __init__(
        self,
        reason: str,
        detail: str | None = None,
        *,
        errors: Sequence[Mapping[str, str]] = (),
        headers: Mapping[str, str] | None = None,
        hint: str | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> None:
        entry = REASONS[reason]
        super().__init__(detail or entry.title)
        self.reason = reason
        self.status = entry.status
        self.detail = detail or entry.meaning
        self.errors = list(errors)[:MAX_ERRORS]
        self.headers = dict(headers or {})
        self.hint = hint
        self.extra = dict(extra or {})

    def document(self, instance: str | None = None, request_id: str | None = None) -> dict[str, Any]:
        """The problem object as it travels."""
        document = problem_document(self.reason, self.detail, hint=self.hint)
        if instance is not None:
            document["instance"] = instance
        if request_id is not None:
            document["request_id"] = request_id
        if self.errors:
            document["errors"] = self.errors
        return document | self.extra


def json_pointer(location: Sequence[str | int]) -> str:
    """The JSON Pointer (RFC 6901) of a place in the request; a member with an odd name is pointed at by its parent."""
    pointer = ""
    for part in location:
        text = str(part)
        if not _PLAIN_NAME.fullmatch(text):
            break
        pointer += f"/{text}"
    return pointer
