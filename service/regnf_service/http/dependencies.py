"""What routes are given: the stores, and the small readings of a request that several of them share."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Query
from redis import Redis
from starlette.requests import Request

from regnf_service.fields.uploads import Upload, open_upload
from regnf_service.http.concurrency import Slots, Waiters
from regnf_service.http.job_watch import JobWatch
from regnf_service.webhooks.policy import Webhooks
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.queue import JobQueue
from regnf_state.records import Quota
from regnf_state.settings import Settings

_UPLOAD_THREADS = 4
_LOOK_THREADS = 2
_Result = TypeVar("_Result")


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
    # threads of their own: neither uploads to a slow disk nor hundreds of looks must keep a poll waiting for one
    upload_limiter: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(_UPLOAD_THREADS))
    look_limiter: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(_LOOK_THREADS))

    @cached_property
    def quota(self) -> Quota:
        """What each caller may have."""
        chosen = self.settings
        return Quota(chosen.quota_active_jobs, chosen.quota_fields, chosen.quota_stored_bytes)

    @cached_property
    def uploads(self) -> Slots:
        """Uploads that are under way."""
        return Slots(self.settings.max_uploads_per_caller, "TOO_MANY_UPLOADS")

    @cached_property
    def streams(self) -> Slots:
        """Event streams that are being read."""
        return Slots(self.settings.max_streams_per_caller, "TOO_MANY_STREAMS")

    @cached_property
    def job_watch(self) -> JobWatch:
        """What all event streams look through."""
        return JobWatch(self.records.news, self.stopping)

    @asynccontextmanager
    async def open_upload(self, caller: str) -> AsyncIterator[Upload]:
        """A new upload into the blob store, within the settings' limits. Raises Problem TOO_MANY_UPLOADS."""
        with self.uploads.held(caller):
            async with open_upload(self.blobs, self.settings.max_upload_bytes, self.upload_limiter) as upload:
                yield upload


def services_of(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


def prefix_of(request: Request) -> str:
    """What the caller's paths begin with: "" or "/v1", behind whatever a proxy put in front."""
    root = str(request.scope.get("root_path", ""))
    path = request.scope["path"].removeprefix(root)
    return root + ("/v1" if path == "/v1" or path.startswith("/v1/") else "")


def caller_of_request(request: Request) -> str:
    """Whose call it is."""
    caller: str = request.state.caller
    return caller


async def in_thread(work: Callable[..., _Result], *arguments: Any) -> _Result:
    """Run blocking work, a call of a store, in a thread."""
    return await to_thread.run_sync(work, *arguments)


ServicesDep = Annotated[Services, Depends(services_of)]
CallerDep = Annotated[str, Depends(caller_of_request)]
PrefixDep = Annotated[str, Depends(prefix_of)]
WaitQuery = Annotated[int, Query(ge=0, le=30, description="Seconds to hold the answer back for news.")]
LimitQuery = Annotated[int, Query(ge=1, le=200, description="How many to return at most.")]
PageTokenQuery = Annotated[str | None, Query(max_length=200, description="`next_page_token` of the page before.")]
