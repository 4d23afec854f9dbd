"""The two functions that workers run. Each runs in a process of its own, forked for one job.

Their arguments: the job's id or the field's reference, which attempt it is, and the worker that runs it.
"""

from __future__ import annotations

from regnf_state.settings import Settings
from regnf_worker.context import Context


def run_registration(job_id: str, attempt: int, worker: str) -> None:
    """Run the attempt at a registration that the queue handed out."""
    from regnf_worker.engine import CoreEngine
    from regnf_worker.registration import run_attempt

    settings = Settings()
    context = Context.from_settings(settings, existing=True)
    run_attempt(context, job_id, attempt, worker, lambda: CoreEngine.on(settings.device, settings.workers))


def run_import(sha256: str, attempt: int, worker: str) -> None:
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
    run_import_attempt(context, sha256, attempt, worker, core_importer(limits))
