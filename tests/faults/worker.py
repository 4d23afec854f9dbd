"""A worker with an engine that does as it is told: `python -m tests.faults.worker`.

Files in the folder REGNF_TEST_GATES make it wait: a registration in its engine (`hold`), once its result stands
(`hold-end`); an import (`hold-import`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from regnf_core.field_notes import FieldViews
from regnf_state.blobs import object_store as object_blobs
from regnf_state.blobs.base import BlobStore
from regnf_state.logs import configure_logging
from regnf_state.manifest import Manifest
from regnf_state.queue import Kind
from regnf_state.registration_request import RegistrationRequest
from regnf_state.settings import Settings
from regnf_worker import artifacts
from regnf_worker import attempt as attempts
from regnf_worker.attempt import run_attempt
from regnf_worker.engine import Made
from regnf_worker.imports import run_import_attempt
from regnf_worker.jobs import draw_field
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from regnf_worker.process import Function, RegnfWorker
from tests.faults.pace import REQUEST_TIMEOUT_S, pace
from tests.worker.tiny_engine import Report, TinyEngine, tiny_importer


def wait_while(gate: str) -> None:
    while is_held(gate):
        time.sleep(0.01)


def is_held(gate: str) -> bool:
    return (Path(os.environ["REGNF_TEST_GATES"]) / gate).exists()


class HeldEngine(TinyEngine):
    """Succeeds, in its own time."""

    def register(
        self,
        scene: Path,
        object_: Path,
        model: Any,
        request: RegistrationRequest,
        report: Report,
        folder: Path,
        notes: Any,
    ) -> Made:
        held = replace(request, detection=replace(request.detection, label="while_held"))
        return super().register(scene, object_, model, held, report, folder, notes)

    def while_held(self, report: Report) -> None:
        while True:
            report("optimizing", 0.5)
            if not is_held("hold"):
                return
            time.sleep(0.01)


def publish(blobs: BlobStore, manifest: Manifest) -> bool:
    published = artifacts.publish(blobs, manifest)
    wait_while("hold-end")
    return published


def held_importer(
    upload: Path, folder: Path, description: dict[str, Any], settings: Path | None, cameras: Path | None = None
) -> dict[str, Any]:
    wait_while("hold-import")
    return tiny_importer(upload, folder, description, settings)


def context(existing: bool = True) -> Context:
    return Context.from_settings(Settings(), existing)


def run_registration(job_id: str, attempt: int, worker: str) -> None:
    shorten_waits()
    attempts.publish = publish
    run_attempt(context(), job_id, attempt, worker, HeldEngine)


def run_import(sha256: str, attempt: int, worker: str) -> None:
    shorten_waits()
    run_import_attempt(context(), sha256, attempt, worker, held_importer)


def run_drawing(reference: str) -> None:
    """Nothing is seen of the fields here."""
    draw_field(context(), reference, lambda _: FieldViews())


FUNCTIONS: Mapping[Kind, Function] = {"import": run_import, "registration": run_registration}
"""What these workers run instead of regnf_worker.jobs."""


def work() -> None:
    scratch = Scratch(Settings().scratch_dir)
    try:
        RegnfWorker(context(existing=False), scratch, functions=FUNCTIONS, draw=run_drawing).serve()
    finally:
        scratch.remove()


def shorten_waits() -> None:
    """What no setting shortens."""
    if not pace().whole:
        object_blobs._REQUEST_TIMEOUT_S = REQUEST_TIMEOUT_S


if __name__ == "__main__":
    configure_logging("text")
    work()
