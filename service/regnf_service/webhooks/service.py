"""Webhooks as a part of the running service: made from its settings, and delivered beside its requests."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Iterable

from anyio import CapacityLimiter, to_thread
from redis import Redis
from redis.exceptions import RedisError

from regnf_service.webhooks.deliverer import Deliverer
from regnf_service.webhooks.policy import Webhooks
from regnf_service.webhooks.sender import HttpSender
from regnf_service.webhooks.signing import read_secrets
from regnf_service.webhooks.targets import AllowList
from regnf_state.record_store import RecordStore
from regnf_state.redis.webhook_outbox import Message, RedisOutbox
from regnf_state.settings import Settings

logger = logging.getLogger(__name__)
_AT_ONCE, _OF_A_CALLER, _OF_A_LINE = 64, 16, 4
"""Messages under way: of all callers, of one, and of one to one receiver."""
_STORE_THREADS = 4
_LOOK_EVERY_S = 1.0
_LAST_S = 1.0
"""Messages under way have so long when the service stops. The others are sent again by whoever starts next."""


def webhooks_of(settings: Settings, redis: Redis) -> Webhooks:
    """What the settings say of webhooks. Raises TokensError."""
    secrets = read_secrets(settings.webhook_secrets, settings.webhook_secrets_file)
    return Webhooks(AllowList(settings.webhook_hosts), secrets, RedisOutbox(redis))


async def deliver_until_stopped(
    webhooks: Webhooks, records: RecordStore, redis: Redis, stopping: asyncio.Event
) -> None:
    """Send what is due until the service stops; nothing where no host is allowed.

    A receiver that does not answer keeps only its own messages of its own caller waiting.
    """
    if not webhooks.allowed:
        return
    sender, threads = HttpSender(webhooks.allowed.permits), CapacityLimiter(_STORE_THREADS)
    deliverer = Deliverer(records, RedisOutbox(redis), sender, webhooks.allowed, webhooks.secrets, threads=threads)
    under_way: dict[asyncio.Task[None], Message] = {}
    stop = asyncio.create_task(stopping.wait())
    while not stopping.is_set():
        message = None
        if len(under_way) < _AT_ONCE:
            message = await _claimed(deliverer, full(under_way.values()), threads)
        if message is not None:
            under_way[asyncio.create_task(_deliver(deliverer, message))] = message
            continue
        done, _ = await asyncio.wait({stop, *under_way}, timeout=_LOOK_EVERY_S, return_when=asyncio.FIRST_COMPLETED)
        under_way = {task: message for task, message in under_way.items() if task not in done}
    if under_way:
        _, late = await asyncio.wait(under_way, timeout=_LAST_S)
        for task in late:
            task.cancel()
        await asyncio.gather(*late, return_exceptions=True)


def full(under_way: Iterable[Message]) -> list[str]:
    """The lines, and the callers, that have as many messages under way as they may."""
    messages = list(under_way)
    lines, callers = Counter(one.line for one in messages), Counter(one.caller for one in messages)
    return [
        *(line for line, count in lines.items() if count >= _OF_A_LINE),
        *(caller for caller, count in callers.items() if count >= _OF_A_CALLER),
    ]


async def _claimed(deliverer: Deliverer, passed_over: list[str], threads: CapacityLimiter) -> Message | None:
    try:
        return await to_thread.run_sync(deliverer.claim, passed_over, limiter=threads)
    except RedisError as error:
        logger.warning("webhooks wait for Redis: %s", type(error).__name__)
    except Exception:
        logger.exception("an internal error: no message is taken from the outbox; it is tried again")
    return None


async def _deliver(deliverer: Deliverer, message: Message) -> None:
    try:
        await deliverer.deliver(message)
    except RedisError as error:
        logger.warning("webhooks wait for Redis: %s", type(error).__name__)
    except Exception:
        logger.exception("an internal error ended the delivery of a message; it comes up again")
