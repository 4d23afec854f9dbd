"""The functions that workers run. Each runs in a process of its own, forked for one job.

The arguments of jobs and imports: the job's id or the field's reference, which attempt it is, and the worker that runs
it.
"""

from __future__ import annotations

from regnf_state.settings import Settings
from regnf_worker.context import Context


def run_registration(job_id: str, attempt: int, worker: str) -> None:
    """Run the attempt at a job that the queue handed out: its record says what it is, a registration or a rendering."""
    from regnf_worker.attempt import run_attempt
    from regnf_worker.engine import CoreEngine

    settings = Settings()
    context = Context.from_settings(settings, existing=True)
    run_attempt(context, job_id, attempt, worker, lambda: CoreEngine.on(settings.device, settings.workers))


def run_import(sha256: str, attempt: int, worker: str) -> None:
    """Run the attempt at an import that the queue handed out, and model the object if it is a library's.

    For a field that became a library's entry after its import, only the model is left to be made.
    """
    from regnf_core.importing.gate.gate import ImportLimits
    from regnf_worker.engine import CoreEngine, core_importer
    from regnf_worker.imports import run_import_attempt
    from regnf_worker.job_limits import JobLimits
    from regnf_worker.library_models import is_unmodeled_entry, model_entry

    settings = Settings()
    limits = ImportLimits(
        wall_s=settings.import_timeout_s,
        work_s=settings.import_work_s,
        memory_bytes=settings.import_memory_bytes,
    )
    context = Context.from_settings(settings, existing=True)
    run_import_attempt(context, sha256, attempt, worker, core_importer(limits))
    if is_unmodeled_entry(context.records, sha256, attempt):
        JobLimits.of(settings).hold_here()
        model_entry(context, sha256, CoreEngine.on(settings.device, settings.workers))


def run_drawing(reference: str) -> None:
    """Draw a field that is ready."""
    from regnf_core.viewing.field_views import field_views
    from regnf_worker.drawing import draw_field

    draw_field(Context.from_settings(Settings(), existing=True), reference, field_views)
