"""Runs one worker: `python -m worker.main`, configured by REGNF_* in the environment."""

from __future__ import annotations

import logging
import os
import sys

from service.logs import configure_logging
from service.settings import Settings
from worker.context import Context, NoRedisError
from worker.kernel import share_cores
from worker.preload import PreloadError, preload
from worker.process import RegnfWorker
from worker.scratch import Scratch

logger = logging.getLogger(__name__)


def run_worker(settings: Settings) -> None:
    """Work until told to stop (SIGTERM, SIGINT). Raises NoRedisError when no Redis is configured, PreloadError."""
    configure_logging(settings.log_format)
    share_cores(os.environ, settings.threads, settings.workers)
    context = Context.from_settings(settings)
    if settings.preload:
        preload()
    scratch = Scratch(settings.scratch_dir)
    try:
        RegnfWorker(context, scratch).serve()
    finally:
        scratch.remove()


def main() -> int:
    try:
        run_worker(Settings())
    except (NoRedisError, PreloadError) as error:
        logger.error("%s: %s", error.reason, error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
