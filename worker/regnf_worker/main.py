"""Runs one worker: `python -m regnf_worker.main`, configured by REGNF_* in the environment."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import MutableMapping
from contextlib import closing

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError

from regnf_state.journal.storage_claim import StorageMismatchError
from regnf_state.logs import configure_logging
from regnf_state.redis.address import NoRedisError, redis_address
from regnf_state.redis.client import WORKER_RETRIES, connect
from regnf_state.settings import Settings
from regnf_worker.context import Context
from regnf_worker.kernel import give_way, share_cores
from regnf_worker.preload import PreloadError, preload
from regnf_worker.process import RegnfWorker
from regnf_worker.scratch import Scratch
from regnf_worker.storage_check import check_storage

_ASKED = "REGNF_PRELOAD"
logger = logging.getLogger(__name__)


def run_worker(settings: Settings) -> None:
    """Work until told to stop (SIGTERM, SIGINT). It is a program's last call: it lowers the process's priority, and may
    begin the program anew.

    Raises NoRedisError when no Redis is configured, redis' ConnectionError or TimeoutError when it does not answer,
    PreloadError, StorageMismatchError.
    """
    configure_logging(settings.log_format)
    context = Context.from_settings(settings)
    with closing(connect(redis_address(settings), retries=WORKER_RETRIES)) as redis:
        redis.ping()  # before the engine is loaded, which takes seconds
    check_storage(settings)
    share_cores(os.environ, settings.threads, settings.workers)
    give_way(settings.job_niceness // 2)  # to the front end: an answer takes milliseconds, a job seconds
    if settings.preload:
        _preload(os.environ)
    scratch = Scratch(settings.scratch_dir)
    try:
        RegnfWorker(context, scratch).serve()
    finally:
        scratch.remove()


def _preload(environment: MutableMapping[str, str]) -> None:
    """Load the engine. Where that starts threads, begin this process anew without it, unless somebody asked for it.

    What is loaded cannot be unloaded. Raises PreloadError.
    """
    try:
        preload()
    except PreloadError as error:
        if _ASKED in environment:
            raise
        logger.warning("%s: %s. The worker starts without it: every job loads the engine itself", error.reason, error)
        os.execve(sys.executable, sys.orig_argv, {**environment, _ASKED: "false"})  # noqa: S606 -- this program again


def main() -> int:
    try:
        run_worker(Settings())
    except (NoRedisError, PreloadError, StorageMismatchError) as error:
        logger.error("%s: %s", error.reason, error)
        return 2
    except (RedisConnectionError, RedisTimeoutError) as error:
        logger.error("REDIS_UNAVAILABLE: Redis does not answer: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
