"""Webhooks as a part of the running service: made from its settings, and delivered beside its requests."""

from __future__ import annotations

import asyncio
import logging

from anyio import CapacityLimiter, to_thread
from redis import Redis
from redis.exceptions import RedisError

from regnf_service.concurrency import pause
from regnf_service.webhooks.deliverer import Deliverer
from regnf_service.webhooks.policy import Webhooks
from regnf_service.webhooks.sender import HttpSender
from regnf_service.webhooks.signing import read_secrets
from regnf_service.webhooks.targets import AllowList
from regnf_state.record_store import RecordStore
from regnf_state.redis.webhook_outbox import RedisOutbox
from regnf_state.settings import Settings

logger = logging.getLogger(__name__)
_AT_ONCE = 4
"""A receiver that does not answer holds one of these for ten seconds."""
_LOOK_EVERY_S = 1.0


def webhooks_of(settings: Settings, redis: Redis) -> Webhooks:
    """What the settings say of webhooks. Raises TokensError."""
    secrets = read_secrets(settings.webhook_secrets, settings.webhook_secrets_file)
    return Webhooks(AllowList(settings.webhook_hosts), secrets, RedisOutbox(redis))


async def deliver_until_stopped(
    webhooks: Webhooks, records: RecordStore, redis: Redis, stopping: asyncio.Event
) -> None:
    """Send what is due, a few at once, until the service stops; nothing where no host is allowed."""
    if not webhooks.allowed:
        return
    sender = HttpSender(webhooks.allowed.permits)
    deliverer = Deliverer(records, RedisOutbox(redis), sender, webhooks.allowed, webhooks.secrets)
    threads = CapacityLimiter(_AT_ONCE)
    await asyncio.gather(*(_deliver(deliverer, stopping, threads) for _ in range(_AT_ONCE)))


async def _deliver(deliverer: Deliverer, stopping: asyncio.Event, threads: CapacityLimiter) -> None:
    while not stopping.is_set():
        try:
            sent = await to_thread.run_sync(deliverer.run_once, limiter=threads)
        except RedisError as error:
            logger.warning("webhooks wait for Redis: %s", type(error).__name__)
            sent = False
        except Exception:
            logger.exception("an internal error ended the delivery of a message; it comes up again")
            sent = False
        if not sent:
            await pause(_LOOK_EVERY_S, stopping)
