"""Runs one worker: `python -m regnf_worker.main`, configured by REGNF_* in the environment."""

from __future__ import annotations

import logging
import os
import sys

from regnf_state.journal.storage_claim import StorageMismatchError
from regnf_state.logs import configure_logging
from regnf_state.redis.address import NoRedisError
from regnf_state.settings import Settings
from regnf_worker.context import Context
from regnf_worker.kernel import give_way, share_cores
from regnf_worker.preload import PreloadError, preload
from regnf_worker.process import RegnfWorker
from regnf_worker.scratch import Scratch
from regnf_worker.storage_check import check_storage

logger = logging.getLogger(__name__)


def run_worker(settings: Settings) -> None:
    """Work until told to stop (SIGTERM, SIGINT). Raises NoRedisError when no Redis is configured, PreloadError,
    StorageMismatchError.
    """
    configure_logging(settings.log_format)
    share_cores(os.environ, settings.threads, settings.workers)
    give_way(settings.job_niceness // 2)  # to the front end: an answer takes milliseconds, a job seconds
    context = Context.from_settings(settings)
    check_storage(settings)
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
    except (NoRedisError, PreloadError, StorageMismatchError) as error:
        logger.error("%s: %s", error.reason, error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
