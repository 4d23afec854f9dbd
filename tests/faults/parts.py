"""The service's processes with short patience and an engine that does as it is told: `python -m tests.faults.parts`.

api FD      the API on a socket it is handed. With REGNF_TEST_DIE it kills itself where a job would be queued.
worker      a worker. Its jobs wait for as long as the file `hold` is in the state folder.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

import uvicorn

from service import app, object_blobs, reaper
from service.logs import configure_logging
from service.redis_client import connect
from service.redis_queue import RqJobQueue
from service.settings import Settings
from tests.worker.tiny_engine import Report, TinyEngine, tiny_importer
from worker.context import Context
from worker.imports import run_import_attempt
from worker.jobs import delivery
from worker.process import RegnfWorker
from worker.registration import run_attempt
from worker.scratch import Scratch

FUNCTIONS = ("tests.faults.parts.run_registration", "tests.faults.parts.run_import")
REQUEST_TIMEOUT_S = 1.0


class DyingQueue(RqJobQueue):
    """A queue that the process does not reach."""

    def enqueue_registration(self, job_id: str, attempt: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class HeldEngine(TinyEngine):
    """Succeeds, in its own time."""

    def register(
        self, scene: Path, object_: Path, model: Any, request: dict[str, Any], report: Report, folder: Path
    ) -> list[str]:
        held = request | {"options": {"do": "while_held"}}
        return super().register(scene, object_, model, held, report, folder)

    def while_held(self, report: Report) -> None:
        while (Settings().state_dir / "hold").exists():
            report("optimising", 0.5)
            time.sleep(0.01)


def run_registration(job_id: str) -> None:
    object_blobs._REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S
    run_attempt(Context.from_settings(Settings()), job_id, *delivery(), HeldEngine)


def run_import(sha256: str) -> None:
    object_blobs._REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S
    run_import_attempt(Context.from_settings(Settings()), sha256, *delivery(), tiny_importer)


def serve_api(descriptor: int) -> None:
    settings = Settings()
    assert settings.redis_url is not None
    app._REAP_EVERY_S = 0.5
    app._STORAGE_PATIENCE_S = 2.0
    reaper._UNHELD_FOR_S = 1.0
    object_blobs._REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S
    kind = DyingQueue if "REGNF_TEST_DIE" in os.environ else RqJobQueue
    application = app.create_app(settings, queue=kind(connect(settings.redis_url), *FUNCTIONS))
    config = uvicorn.Config(application, log_config=None, access_log=False, lifespan="on", timeout_graceful_shutdown=2)
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=descriptor)])


def work() -> None:
    context = Context.from_settings(Settings())
    scratch = Scratch(context.settings.scratch_dir)
    try:
        RegnfWorker(context, scratch).serve()
    finally:
        scratch.remove()


if __name__ == "__main__":
    configure_logging("text")
    if sys.argv[1] == "api":
        serve_api(int(sys.argv[2]))
    else:
        work()
