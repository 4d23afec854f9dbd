"""The fields that a job reads: waited for until their import has ended, then files for as long as the job runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from regnf_core.errors import InvalidInputError
from regnf_state.ownership import sha256_of
from regnf_state.records import FieldRecord
from regnf_worker.context import Context
from regnf_worker.heartbeat import Heartbeat

_POLL_S = 0.2
_WAIT_BEFORE_GIVING_BACK_S = 20.0


class FieldsNotReadyError(Exception):
    """A field is still being imported; the job goes back to the queue, so that the worker is free for others."""


class Fields:
    """Fields of one job. Whatever is opened stays open until ``stack`` closes."""

    def __init__(self, context: Context, heartbeat: Heartbeat, stack: ExitStack) -> None:
        self._context = context
        self._heartbeat = heartbeat
        self._stack = stack
        self._deadline = time.monotonic() + _WAIT_BEFORE_GIVING_BACK_S

    def ready(self, references: Sequence[str]) -> list[FieldRecord]:
        """The fields' records, once their imports have ended; all of them are asked for at once.

        Raises InvalidInputError (FIELD_NOT_FOUND, FIELD_REJECTED, FIELD_IMPORT_TIMEOUT), FieldsNotReadyError.
        """
        while True:
            found = self._usable(references)
            awaited = next((one.sha256 for one in found if one.state == "validating"), None)
            if awaited is None:
                return found
            self._heartbeat.check()
            if time.monotonic() > self._deadline:
                raise FieldsNotReadyError(awaited)
            time.sleep(_POLL_S)

    def file(self, sha256: str) -> Path:
        """The safe field file of a field that is ready."""
        return self._stack.enter_context(self._context.blobs.local_copy(f"fields/{sha256}/field.safetensors"))

    def _usable(self, references: Sequence[str]) -> list[FieldRecord]:
        found = self._context.records.get_fields(references)
        return [self._checked(field, sha256_of(name)) for field, name in zip(found, references, strict=True)]

    def _checked(self, field: FieldRecord | None, name: str) -> FieldRecord:
        """One that may still become, or is, ready."""
        if field is None:
            raise InvalidInputError(f"field {name} was deleted", reason="FIELD_NOT_FOUND")
        if field.state == "rejected":
            why = (field.error or {}).get("reason", "unknown")
            raise InvalidInputError(f"field {name} was rejected: {why}", reason="FIELD_REJECTED")
        settings = self._context.settings
        longest = 2 * (settings.import_timeout_s + settings.lost_after_s)
        if field.state == "validating" and self._context.records.now() - field.updated > longest:
            message = f"field {name} was not imported within {longest:g} s (twice REGNF_IMPORT_TIMEOUT_S and more)"
            raise InvalidInputError(message, reason="FIELD_IMPORT_TIMEOUT")
        return field
