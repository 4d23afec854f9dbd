"""The service's processes with an engine that does as it is told: `python -m tests.faults.parts`.

api FD      the API on a socket it is handed. With REGNF_TEST_DIE it kills itself where a job would be queued.
worker      a worker. In the folder REGNF_TEST_GATES files make it wait: a registration in its engine (`hold`), once its
            result stands (`hold-end`); an import (`hold-import`).
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import uvicorn

from service import app, lifespan, object_blobs, reaper
from service.blobs import BlobStore
from service.logs import configure_logging
from service.redis_client import connect
from service.redis_queue import RqJobQueue
from service.settings import Settings
from tests.faults.pace import pace
from tests.worker.tiny_engine import Report, TinyEngine, tiny_importer
from worker import artifacts, registration
from worker.context import Context
from worker.imports import run_import_attempt
from worker.jobs import delivery
from worker.process import RegnfWorker
from worker.registration import run_attempt
from worker.scratch import Scratch

FUNCTIONS = ("tests.faults.parts.run_registration", "tests.faults.parts.run_import")


class DyingQueue(RqJobQueue):
    """A queue that the process does not reach."""

    def enqueue_registration(self, job_id: str, attempt: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


def wait_while(gate: str) -> None:
    while is_held(gate):
        time.sleep(0.01)


def is_held(gate: str) -> bool:
    return (Path(os.environ["REGNF_TEST_GATES"]) / gate).exists()


class HeldEngine(TinyEngine):
    """Succeeds, in its own time."""

    def register(
        self, scene: Path, object_: Path, model: Any, request: dict[str, Any], report: Report, folder: Path
    ) -> list[str]:
        held = request | {"options": {"do": "while_held"}}
        return super().register(scene, object_, model, held, report, folder)

    def while_held(self, report: Report) -> None:
        while True:
            report("optimising", 0.5)
            if not is_held("hold"):
                return
            time.sleep(0.01)


def publish(blobs: BlobStore, job_id: str, manifest: artifacts.Manifest) -> bool:
    stands = artifacts.publish(blobs, job_id, manifest)
    wait_while("hold-end")
    return stands


def held_importer(upload: Path, folder: Path, description: dict[str, Any]) -> dict[str, Any]:
    wait_while("hold-import")
    return tiny_importer(upload, folder, description)


def context(existing: bool = True) -> Context:
    """Everything real but the functions that the queue names."""
    settings = Settings()
    assert settings.redis_url is not None
    return replace(Context.from_settings(settings, existing), queue=RqJobQueue(connect(settings.redis_url), *FUNCTIONS))


def run_registration(job_id: str) -> None:
    shorten_patience()
    registration.publish = publish
    run_attempt(context(), job_id, *delivery(), HeldEngine)


def run_import(sha256: str) -> None:
    shorten_patience()
    run_import_attempt(context(), sha256, *delivery(), held_importer)


def shorten_patience() -> None:
    """What no setting shortens; nothing in the whole version."""
    if pace().whole:
        return
    lifespan._REAP_EVERY_S = 0.5
    app._STORAGE_PATIENCE_S = 0.7
    reaper._UNHELD_FOR_S = 2.0
    object_blobs._REQUEST_TIMEOUT_S = 0.7


def serve_api(descriptor: int) -> None:
    shorten_patience()
    settings = Settings()
    assert settings.redis_url is not None
    kind = DyingQueue if "REGNF_TEST_DIE" in os.environ else RqJobQueue
    application = app.create_app(settings, queue=kind(connect(settings.redis_url), *FUNCTIONS))
    config = uvicorn.Config(application, log_config=None, access_log=False, lifespan="on", timeout_graceful_shutdown=2)
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=descriptor)])


def work() -> None:
    scratch = Scratch(Settings().scratch_dir)
    try:
        RegnfWorker(context(existing=False), scratch).serve()
    finally:
        scratch.remove()


if __name__ == "__main__":
    configure_logging("text")
    if sys.argv[1] == "api":
        serve_api(int(sys.argv[2]))
    else:
        work()
