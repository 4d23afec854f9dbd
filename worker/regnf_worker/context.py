"""What a job is given: settings and stores, made from the environment in the job's own process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from regnf_state.blobs.base import BlobStore
from regnf_state.originals import Originals
from regnf_state.queue import JobQueue
from regnf_state.record_store import RecordStore
from regnf_state.settings import Settings
from regnf_state.stores import open_stores

_RETRIES = 20
"""About eighteen seconds: a job outlives a restart of Redis."""
_STORAGE_WAIT_S = 120.0


@dataclass(frozen=True)
class Context:
    """Settings and stores of one process."""

    settings: Settings
    records: RecordStore
    blobs: BlobStore
    queue: JobQueue

    @cached_property
    def originals(self) -> Originals:
        """The uploads that stay after their import."""
        return Originals(self.records, self.blobs, self.settings)

    @classmethod
    def from_settings(cls, settings: Settings, existing: bool = False) -> Context:
        """The stores that the settings name; ``existing`` as ``open_stores`` has it. Raises NoRedisError."""
        stores = open_stores(settings, retries=_RETRIES, storage_wait_s=_STORAGE_WAIT_S, existing=existing)
        return cls(settings, stores.records, stores.blobs, stores.queue)
