"""Finding a caller's batch by its id."""

from __future__ import annotations

import re
from typing import NamedTuple

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.batch_records import Batch, BatchName, BatchState

_BATCH_ID = re.compile(r"[0-9a-f]{32}")


class Found(NamedTuple):
    """A batch, and where it is."""

    batch: Batch
    state: BatchState


def find_batch(services: Services, caller: str, batch_id: str) -> Found:
    """The caller's own. Raises Problem BATCH_NOT_FOUND, BATCH_EXPIRED, UnreadableRecordError."""
    name = BatchName(caller, batch_id)
    if not _BATCH_ID.fullmatch(batch_id):
        raise Problem("BATCH_NOT_FOUND")
    try:
        batch = services.batches.find(name)
        if batch is not None:
            return Found(batch, services.batches.state(name))
    except FileNotFoundError:
        pass  # it is being deleted
    raise Problem("BATCH_EXPIRED" if services.batches.index.has_expired(name) else "BATCH_NOT_FOUND")
