"""A real worker process whose jobs run the tiny engine: `python -m tests.worker.tiny_worker`, set up by REGNF_*."""

from __future__ import annotations

from collections.abc import Mapping

from regnf_state.logs import configure_logging
from regnf_state.queue import Kind
from regnf_state.settings import Settings
from regnf_worker import process
from regnf_worker.context import Context
from regnf_worker.scratch import Scratch
from tests.worker import tiny_engine

FUNCTIONS: Mapping[Kind, process.Function] = {
    "import": tiny_engine.run_import,
    "registration": tiny_engine.run_registration,
}
"""What these workers run instead of regnf_worker.jobs."""


if __name__ == "__main__":
    configure_logging("text")
    process._LATE_GRACE_S = 1.0
    context = Context.from_settings(Settings())
    scratch = Scratch(context.settings.scratch_dir)
    try:
        process.RegnfWorker(context, scratch, functions=FUNCTIONS, draw=tiny_engine.run_drawing).serve()
    finally:
        scratch.remove()
