"""Records, blobs and queue in memory: doubles for unit tests that keep the same promises as the real ones."""

from regnf_state.memory.blobs import InMemoryBlobStore
from regnf_state.memory.queue import InMemoryJobQueue
from regnf_state.memory.records import InMemoryRecordStore

__all__ = ["InMemoryBlobStore", "InMemoryJobQueue", "InMemoryRecordStore"]
