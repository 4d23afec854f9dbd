"""A real worker process whose jobs run the tiny engine: `python -m tests.worker.tiny_worker`, set up by REGNF_*."""

from __future__ import annotations

from dataclasses import replace

from service.logs import configure_logging
from service.redis_client import connect
from service.redis_queue import RqJobQueue
from service.settings import Settings
from worker import process
from worker.context import Context
from worker.scratch import Scratch

FUNCTIONS = ("tests.worker.tiny_engine.run_registration", "tests.worker.tiny_engine.run_import")


def tiny_context() -> Context:
    """Everything real but the functions that the queue names."""
    settings = Settings()
    assert settings.redis_url is not None
    return replace(Context.from_settings(settings), queue=RqJobQueue(connect(settings.redis_url), *FUNCTIONS))


if __name__ == "__main__":
    configure_logging("text")
    process._LATE_GRACE_S = 1.0
    context = tiny_context()
    scratch = Scratch(context.settings.scratch_dir)
    try:
        process.RegnfWorker(context, scratch).serve()
    finally:
        scratch.remove()
