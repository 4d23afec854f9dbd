"""A real worker process whose jobs run the tiny engine: `python -m tests.worker.tiny_worker`, set up by REGNF_*."""

from __future__ import annotations

from dataclasses import replace

from regnf_state.logs import configure_logging
from regnf_state.redis.client import connect
from regnf_state.redis.queue import RqJobQueue
from regnf_state.settings import Settings
from regnf_worker import process
from regnf_worker.context import Context
from regnf_worker.scratch import Scratch

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
