"""Runs one worker: `python -m regnf_worker.main`, configured by REGNF_* in the environment."""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import MutableMapping
from contextlib import closing
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError
from redis.exceptions import TimeoutError as RedisTimeoutError

from regnf_core.errors import InvalidInputError
from regnf_core.options import RegistrationOptions
from regnf_state.journal.journal import StorageMismatchError, claim_storage
from regnf_state.logs import configure_logging
from regnf_state.redis.client import WORKER_RETRIES, NoRedisError, connect, redis_address
from regnf_state.settings import Settings, read_settings
from regnf_state.stores import open_stores
from regnf_worker import kernel
from regnf_worker.kernel import Scratch, give_way, share_cores
from regnf_worker.models import Context
from regnf_worker.process import RegnfWorker

# Loading the engine into the worker's own process, once, so that its children find it there: REGNF_PRELOAD.
#
# A child of a process that has threads may hang: of a pool of threads, a fork copies the locks and not the threads.
# So nothing is run here, only imported. torch starts its threads with its first operation, CUDA its context with the
# first call, and both happen in children only; OpenBLAS, numpy's, starts its threads as it is loaded and is therefore
# told to have none, here and in the children.

_MODULES = (
    "regnf_worker.engine",
    "regnf_worker.attempt",
    "regnf_core.geometry.box",
    "regnf_core.viewing.artifacts",
    "regnf_core.fields.build",
    "regnf_core.library",
    "regnf_core.paper.pipeline",
    "regnf_core.rendering.job",
    "regnf_data.recordings.importing",
    "regnf_data.recordings.stored",
    "regnf_fit.images.place",
    "regnf_fit.images.recorded_scene",
    "regnf_fit.images.overlay",
    "regnf_core.geometry.sim3",
    *(f"PIL.{kind}ImagePlugin" for kind in ("Bmp", "Gif", "Jpeg", "Png", "Ppm")),
)
"""What regnf_worker.engine imports where it needs it, and what Pillow does when it opens the first image."""
_PREPARED = ("regnf_core.schema.safe_format:prepare_kinds", "regnf_core.native.library:variant")
"""What is made once in a process, and takes a job milliseconds to make."""


class PreloadError(RuntimeError):
    """Something that was loaded has started threads: children could hang."""

    reason = "PRELOAD_THREADS"


def preload() -> None:
    """Load what registrations need. Raises PreloadError if the process has several threads afterwards (Linux)."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    gc.disable()  # what loads stays
    for name in _MODULES:
        import_module(name)
    for name in _PREPARED:
        resolve_name(name)()
    RegistrationOptions.from_dict({"preset": "robust"})  # makes the validator that every job needs
    tasks = Path("/proc/self/task")
    if tasks.exists() and len(list(tasks.iterdir())) > 1:
        raise PreloadError("a preloaded library has started threads; unset REGNF_PRELOAD")
    gc.enable()
    gc.freeze()  # a collection in a child would otherwise copy the pages of everything that was loaded


# Before a worker takes jobs: is its storage the one whose records Redis holds?

_WAIT_S = 10.0


def check_storage(settings: Settings) -> None:
    """Raises StorageMismatchError. Says nothing while Redis or the storage is away: the front end looks again.

    In a process of its own: a client of an object store does not survive the forks to come.
    """
    reading, writing = os.pipe()

    def tell() -> None:
        os.write(writing, _mismatch(settings).encode())

    try:
        kernel.in_child(tell)
    finally:
        os.close(writing)
    with os.fdopen(reading, "rb") as told:
        message = told.read().decode()
    if message:
        raise StorageMismatchError(message)


def _mismatch(settings: Settings) -> str:
    """What is wrong; "" when nothing is, or nobody can tell."""
    stores = open_stores(settings, retries=0, storage_wait_s=_WAIT_S)
    try:
        claim_storage(stores.redis, stores.records.journal.storage_id(), settings.adopt_storage or None)
    except StorageMismatchError as error:
        return str(error)
    except (RedisError, OSError):
        pass
    return ""


_ASKED = "REGNF_PRELOAD"
_NICENESS = 5
"""Jobs give way to the front end: an answer takes milliseconds, a job seconds."""
logger = logging.getLogger(__name__)


def run_worker(settings: Settings) -> None:
    """Work until told to stop (SIGTERM, SIGINT). It is a program's last call: it lowers the process's priority, and may
    begin the program again.

    Raises NoRedisError when no Redis is configured, redis' ConnectionError or TimeoutError when it does not answer,
    PreloadError, StorageMismatchError.
    """
    configure_logging(settings.log_format)
    context = Context.from_settings(settings)
    with closing(connect(redis_address(settings), retries=WORKER_RETRIES)) as redis:
        redis.ping()  # before the engine is loaded, which takes seconds
    check_storage(settings)
    share_cores(os.environ, settings.threads, settings.workers)
    give_way(_NICENESS)
    if settings.preload:
        _preload(os.environ)
    scratch = Scratch(settings.scratch_dir)
    try:
        RegnfWorker(context, scratch).serve()
    finally:
        scratch.remove()


def _preload(environment: MutableMapping[str, str]) -> None:
    """Load the engine. Where that starts threads, begin this process again without it, unless somebody requested it.

    What is loaded cannot be unloaded. Raises PreloadError.
    """
    try:
        preload()
    except PreloadError as error:
        if _ASKED in environment:
            raise
        logger.warning(
            "%s: %s. The worker starts without preloading: every job loads the engine itself", error.reason, error
        )
        os.execve(sys.executable, sys.orig_argv, {**environment, _ASKED: "false"})  # noqa: S606 -- this program again


def main() -> int:
    try:
        run_worker(read_settings())
    except (InvalidInputError, NoRedisError, PreloadError, StorageMismatchError) as error:
        logger.error("%s: %s", error.reason, error)
        return 2
    except (RedisConnectionError, RedisTimeoutError) as error:
        logger.error("REDIS_UNAVAILABLE: Redis does not answer: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
