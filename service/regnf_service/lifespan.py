"""What the application does beside requests: it finds lost jobs, sends webhooks, serves metrics, and stops in order."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager

from fastapi import FastAPI
from redis.exceptions import RedisError

from regnf_service.concurrency import in_thread, pause
from regnf_service.http.hosts import allowed_hosts
from regnf_service.metrics import Metrics
from regnf_service.metrics_port import served
from regnf_service.services import Services
from regnf_service.shutdown import stopping_on_signals
from regnf_service.upkeep.housekeeping import Housekeeper
from regnf_service.upkeep.reaper import Reaper
from regnf_service.webhooks.service import deliver_until_stopped
from regnf_state.journal.rebuild import Rebuilder
from regnf_state.journal.storage_claim import StorageMismatchError, claim_storage

logger = logging.getLogger(__name__)
_REAP_EVERY_S = 15.0
_CLEARING_UP_S = 5.0


def lifespan_of(services: Services, metrics: Metrics) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """The lifespan of an application over these services: starts its background tasks, and stops them in order."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.openapi()  # takes a while, so not during the first request
        await in_thread(_check_storage, services)
        reaping = asyncio.create_task(_reap(services))
        delivering = asyncio.create_task(
            deliver_until_stopped(services.webhooks, services.records, services.redis, services.stopping)
        )
        at = services.settings
        scrapes = served(metrics.registry, allowed_hosts(at), at.metrics_host, at.metrics_port)
        with scrapes, stopping_on_signals(services.stopping):
            yield
        services.stopping.set()
        # the server has interrupted the uploads that were running, and does not wait until they are cleaned up
        await services.uploads.emptied(_CLEARING_UP_S)
        await delivering
        await reaping
        services.redis.close()

    return lifespan


def _check_storage(services: Services) -> None:
    """Raises StorageMismatchError: the start fails. While a store is away nobody can tell, and the reaper will."""
    try:
        claim_storage(services.redis, services.records.journal.storage_id(), services.settings.adopt_storage or None)
    except (RedisError, OSError) as error:
        logger.warning("whose records Redis holds is looked up later: %s", type(error).__name__)
    except StorageMismatchError as error:
        logger.critical("%s: %s", error.reason, error)
        raise


async def _reap(services: Services) -> None:
    """Look after lost jobs every fifteen seconds until the service stops."""
    records, queue, redis, blobs = services.records, services.queue, services.redis, services.blobs
    rebuilder = Rebuilder(records, queue, blobs)
    housekeeper = Housekeeper(records, blobs, redis, services.settings)
    reaper = Reaper(records, queue, redis, services.settings, blobs, rebuilder, housekeeper)
    while not services.stopping.is_set():
        try:
            await in_thread(reaper.run_once)
        except StorageMismatchError as error:
            logger.critical("%s: %s", error.reason, error)
            signal.raise_signal(signal.SIGTERM)  # it would mix the jobs of two services
        except (RedisError, OSError) as error:
            logger.warning("the reaper: a store does not answer: %s", type(error).__name__)
        except Exception:
            logger.exception("an internal error ended this round of the reaper; the next round follows")
        await pause(_REAP_EVERY_S, services.stopping)
