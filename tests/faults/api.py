"""The API, with short waits unless in the whole version: `python -m tests.faults.api FD`, a socket it is handed.

With REGNF_TEST_DIE=n it kills itself where jobs would be queued for the n-th time.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Sequence
from dataclasses import replace

import uvicorn

from regnf_service import server
from regnf_service.upkeep import reaper
from regnf_state.blobs import object_store as object_blobs
from regnf_state.logs import configure_logging
from regnf_state.records import JobRecord
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from tests.faults.pace import REQUEST_TIMEOUT_S, pace


class DyingQueue(JobQueue):
    """A queue that the process does not reach."""

    _calls_left = int(os.environ.get("REGNF_TEST_DIE", "1"))

    def enqueue_jobs(self, jobs: Sequence[JobRecord]) -> None:
        self._calls_left -= 1
        if not self._calls_left:
            os.kill(os.getpid(), signal.SIGKILL)
        super().enqueue_jobs(jobs)


def shorten_waits() -> None:
    """What no setting shortens."""
    server._REAP_EVERY_S = 0.5
    server._STORAGE_WAIT_S = 0.7
    reaper._UNHELD_FOR_S = 2.0
    reaper._LEADS_FOR_S = 3
    object_blobs._REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S


def serve(descriptor: int) -> None:
    settings = Settings()
    kind = DyingQueue if "REGNF_TEST_DIE" in os.environ else JobQueue
    stores = server.open_stores(settings, retries=None, storage_wait_s=server._STORAGE_WAIT_S)
    application = server.create_app(settings, replace(stores, queue=kind(stores.redis)))
    config = uvicorn.Config(application, log_config=None, access_log=False, lifespan="on", timeout_graceful_shutdown=2)
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=descriptor)])


if __name__ == "__main__":
    configure_logging("text")
    if not pace().whole:
        shorten_waits()
    serve(int(sys.argv[1]))
