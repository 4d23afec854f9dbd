"""What every part of the service is given: settings, stores, and the limits that hold across requests."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from functools import cached_property

from redis import Redis

from regnf_service.bytes_under_way import UnderWay
from regnf_service.concurrency import Slots, Waiters
from regnf_service.job_watch import JobWatch
from regnf_service.upload_slots import Assemblies, UploadSlots
from regnf_service.webhooks.policy import Webhooks
from regnf_state.batches import Batches
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.originals import Originals
from regnf_state.pieces import Pieces
from regnf_state.queue import JobQueue
from regnf_state.quota import quota_of
from regnf_state.records import Quota
from regnf_state.room import Room
from regnf_state.settings import Settings

_ASSEMBLIES = 4
"""Each holds a copy of a whole upload for a moment."""


@dataclass(frozen=True)
class Services:
    """What every request may use. ``stopping`` is set when the process is to end: long answers then end too."""

    settings: Settings
    redis: Redis
    records: JournaledRecordStore
    blobs: BlobStore
    queue: JobQueue
    webhooks: Webhooks
    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    waiters: Waiters = field(default_factory=Waiters)

    @cached_property
    def quota(self) -> Quota:
        """What each caller may have."""
        return quota_of(self.settings)

    @cached_property
    def room(self) -> Room:
        """Room for new records."""
        return Room(self.records, self.blobs, self.redis, self.settings)

    @cached_property
    def originals(self) -> Originals:
        """The uploads that stay after their import."""
        return Originals(self.records, self.blobs, self.settings)

    @cached_property
    def pieces(self) -> Pieces:
        """Uploads that come in pieces and are not finished."""
        return Pieces(self.blobs, self.settings)

    @cached_property
    def batches(self) -> Batches:
        """Batches of registrations."""
        return Batches(self.blobs)

    @cached_property
    def requests(self) -> Slots:
        """Requests that are in progress."""
        return Slots(self.settings.max_requests_per_caller, "TOO_MANY_REQUESTS_AT_ONCE")

    @cached_property
    def uploads(self) -> UploadSlots:
        """Uploads that are under way."""
        return UploadSlots(self.settings.max_uploads_per_caller)

    @cached_property
    def assembling(self) -> Assemblies:
        """Uploads whose pieces are being put together."""
        return Assemblies(_ASSEMBLIES)

    @cached_property
    def under_way(self) -> UnderWay:
        """The bytes of these uploads."""
        return UnderWay()

    @cached_property
    def streams(self) -> Slots:
        """Event streams that are being read."""
        return Slots(self.settings.max_streams_per_caller, "TOO_MANY_STREAMS")

    @cached_property
    def job_watch(self) -> JobWatch:
        """What all event streams look through."""
        return JobWatch(self.records.news, self.stopping)
