"""Records, blobs and queue in memory: doubles for unit tests that keep the same promises as the real ones."""

from service.memory.blobs import InMemoryBlobStore
from service.memory.queue import InMemoryJobQueue
from service.memory.records import InMemoryRecordStore

__all__ = ["InMemoryBlobStore", "InMemoryJobQueue", "InMemoryRecordStore"]
