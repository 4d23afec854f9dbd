"""The feeder's rounds, for as long as the service runs."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress

from redis.exceptions import RedisError

from regnf_service.batches.feeder import Feeder, Requests
from regnf_service.concurrency import in_thread
from regnf_service.services import Services

_ROUND_S = 0.5
_IDLE_S = 2.0
"""Between looks for batches that other front ends have taken."""
_EXPIRE_EVERY_S = 60.0
logger = logging.getLogger(__name__)


async def feed_until_stopped(services: Services, requests: Requests) -> None:
    """Rounds twice a second while there are batches."""
    feeder = Feeder(services, requests)
    expire_at = 0.0
    while not services.stopping.is_set():
        services.batch_posted.clear()
        goes_on = False
        try:
            goes_on = await in_thread(feeder.run_once)
            if time.monotonic() >= expire_at:
                expire_at = time.monotonic() + _EXPIRE_EVERY_S
                await in_thread(feeder.expire)
        except (RedisError, OSError) as error:
            logger.warning("batches wait: a store does not answer: %s", type(error).__name__)
        except Exception:
            logger.exception("an internal error ended this round of the batches; the next round follows")
        await _pause(services, _ROUND_S if goes_on else _IDLE_S)


async def _pause(services: Services, seconds: float) -> None:
    """Wait for so long; less where a batch is posted or the service stops."""
    waits = [asyncio.create_task(event.wait()) for event in (services.batch_posted, services.stopping)]
    try:
        await asyncio.wait(waits, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for one in waits:
            one.cancel()
            with suppress(asyncio.CancelledError):
                await one
