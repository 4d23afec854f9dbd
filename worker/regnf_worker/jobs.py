"""The functions that the queue names. Each runs in a process of its own, forked for one job, and takes one id."""

from __future__ import annotations

from rq import get_current_job

from regnf_state.redis.queue import attempt_of
from regnf_state.settings import Settings
from regnf_worker.context import Context


def run_registration(job_id: str) -> None:
    """Run the attempt at a registration that the queue handed out."""
    from regnf_worker.engine import CoreEngine
    from regnf_worker.registration import run_attempt

    settings = Settings()
    context = Context.from_settings(settings, existing=True)
    run_attempt(context, job_id, *delivery(), lambda: CoreEngine.on(settings.device, settings.workers))


def run_import(sha256: str) -> None:
    """Run the attempt at an import that the queue handed out."""
    from regnf_core.importing.gate.gate import ImportLimits
    from regnf_worker.engine import core_importer
    from regnf_worker.imports import run_import_attempt

    settings = Settings()
    limits = ImportLimits(
        wall_s=settings.import_timeout_s,
        work_s=settings.import_work_s,
        memory_bytes=settings.import_memory_bytes,
    )
    context = Context.from_settings(settings, existing=True)
    run_import_attempt(context, sha256, *delivery(), core_importer(limits))


def delivery() -> tuple[int, str]:
    """Which attempt the running queue job is, and by which worker it is run."""
    job = get_current_job()
    assert job is not None, "called by a worker only"
    assert job.worker_name is not None, "set before the job begins"
    return attempt_of(job.id), job.worker_name
