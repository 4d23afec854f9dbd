"""The HTTP server of `regnf serve` and of the images: uvicorn, and the application that it serves."""

from __future__ import annotations

import asyncio
import gc
import logging
import resource
import signal
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import Depends, FastAPI
from redis.exceptions import RedisError
from starlette.middleware import Middleware
from starlette.staticfiles import StaticFiles

from regnf_core import __version__
from regnf_service.concurrency import in_thread, pause
from regnf_service.http import problems
from regnf_service.http.contract import build_contract
from regnf_service.http.hosts import allowed_hosts, cors_origins
from regnf_service.http.middleware import RequestContext, RequestGate, TokenGate, TurnGate
from regnf_service.http.origins import OriginGate, cors_layer
from regnf_service.http.query import refuse_unknown_parameters
from regnf_service.http.rate_limits import RateGate, RateLimiter
from regnf_service.http.routes import LENIENT_ROUTERS, ROUTERS
from regnf_service.metrics import Metrics, served
from regnf_service.services import Services
from regnf_service.tokens import Callers, read_callers
from regnf_service.upkeep.housekeeping import Housekeeper
from regnf_service.upkeep.reaper import Reaper
from regnf_service.webhooks.service import deliver_until_stopped, webhooks_of
from regnf_state.journal.journal import StorageMismatchError, claim_storage
from regnf_state.journal.journaled_records import Rebuilder
from regnf_state.settings import Settings
from regnf_state.stores import Stores, open_stores

# Ends long responses when the process must stop.
#
# The server waits for open connections before it ends the application, so an event stream that waits for the
# application's end would never end. Hence we listen to the signals ourselves, and pass them on.

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stopping_on_signals(stopping: asyncio.Event) -> Iterator[None]:
    """Set ``stopping`` when SIGINT or SIGTERM arrives, before the earlier handler is called."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    loop = asyncio.get_running_loop()
    # a signal without a Python handler keeps its default, which ends the process anyway
    earlier = {number: handler for number in _SIGNALS if callable(handler := signal.getsignal(number))}

    def listen(number: int, frame: FrameType | None) -> None:
        loop.call_soon_threadsafe(stopping.set)
        earlier[signal.Signals(number)](number, frame)

    for number in earlier:
        signal.signal(number, listen)
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)


# What the application does beside requests: it finds lost jobs, sends webhooks, serves metrics, and stops in order.

_REAP_EVERY_S = 15.0
_CLEARING_UP_S = 5.0


def lifespan_of(services: Services, metrics: Metrics) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """The lifespan of an application over these services: starts its background tasks, and stops them in order."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        await in_thread(_check_storage, services)
        contract = asyncio.create_task(in_thread(app.openapi))  # takes a while, so not when it is requested
        reaping = asyncio.create_task(_reap(services))
        delivering = asyncio.create_task(deliver_until_stopped(services.webhooks, services.records, services.stopping))
        with served(metrics.registry, services.settings.metrics_address), stopping_on_signals(services.stopping):
            yield
        services.stopping.set()
        # the server has interrupted the uploads that were running, and does not wait until they are cleaned up
        await services.uploads.emptied(_CLEARING_UP_S)
        await delivering
        await reaping
        await contract
        services.redis.close()

    return lifespan


def _check_storage(services: Services) -> None:
    """Raises StorageMismatchError: the start fails. While a store is away nobody can tell, and the reaper will."""
    try:
        claim_storage(services.redis, services.records.journal.storage_id(), services.settings.adopt_storage or None)
    except (RedisError, OSError) as error:
        logger.warning("the owner of Redis's records is checked later: %s", type(error).__name__)
    except StorageMismatchError as error:
        logger.critical("%s: %s", error.reason, error)
        raise


async def _reap(services: Services) -> None:
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
            logger.warning("the reaper: a store does not respond: %s", type(error).__name__)
        except Exception:
            logger.exception("an internal error ended this round of the reaper; the next round will run")
        await pause(_REAP_EVERY_S, services.stopping)


# The HTTP application. `create_app` is the factory that servers call; tests hand it their own stores.

_STORAGE_WAIT_S = 10.0
_STRICT = [Depends(refuse_unknown_parameters)]


def create_app(
    settings: Settings | None = None,
    stores: Stores | None = None,
    limiter: RateLimiter | None = None,
) -> FastAPI:
    """The application over the given stores, or over those that the settings name.

    Raises NoRedisError when no Redis is named, TokensError when the tokens are unusable, HostsError likewise.
    """
    settings = settings or Settings()
    callers = read_callers(settings.api_tokens)
    stores = stores or open_stores(settings, retries=None, storage_wait_s=_STORAGE_WAIT_S)
    if limiter is None and settings.calls_per_s:
        limiter = RateLimiter(stores.redis, settings.calls_per_s, settings.rate_limit_burst)
    webhooks = webhooks_of(settings, stores.redis)
    services = Services(settings, stores.redis, stores.records, stores.blobs, stores.queue, webhooks)
    metrics = Metrics(services)
    app = FastAPI(
        title="regnf",
        version=__version__,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,  # the framework's redirects lead to whatever `Host` says
        generate_unique_id_function=lambda route: route.name,
        lifespan=lifespan_of(services, metrics),
        middleware=_middleware(services, callers, metrics, limiter),
    )
    app.state.services = services
    app.state.metrics = metrics
    _include_routers(app)
    app.openapi = cache(lambda: build_contract(app))  # type: ignore[method-assign]
    _include_routers(app, prefix="/v1", include_in_schema=False)
    app.mount("/static", StaticFiles(directory=Path(__file__).with_name("web")), name="static")
    problems.install(app)
    return app


def _middleware(
    services: Services, callers: Callers, metrics: Metrics, limiter: RateLimiter | None
) -> list[Middleware]:
    """What every request passes through, outermost first."""
    settings = services.settings
    gate = Middleware(
        TokenGate,
        needs_token=settings.needs_token,
        allow_unauthenticated=settings.allow_unauthenticated or settings.published_on_loopback,
    )
    limits = [Middleware(RequestGate, slots=services.requests)]
    if limiter is not None:
        limits.append(Middleware(RateGate, limiter=limiter))
    origins = cors_origins(settings)
    hosts = Middleware(OriginGate, hosts=allowed_hosts(settings), origins=origins)
    turns = Middleware(TurnGate, callers=callers if settings.needs_token else {})
    return [
        Middleware(RequestContext, count=metrics.count),
        turns,
        hosts,
        *cors_layer(origins),
        gate,
        *limits,
    ]


def _include_routers(app: FastAPI, **how: Any) -> None:
    for router in ROUTERS:
        app.include_router(router, dependencies=_STRICT, **how)
    for router in LENIENT_ROUTERS:
        app.include_router(router, **how)


_DRAIN_S = 5
"""How long open requests may continue when the process must stop."""
_MOST_HEAD_BYTES = 16 * 1024
_IDLE_S = 75
"""How long a connection stays open between two requests: longer than a proxy keeps one that it may use again."""
_MOST_DESCRIPTORS = 65536
_SWITCH_S = 0.001
"""After how long a thread that computes lets the next one on: a call passes through several, and each time waits for
those of others. The interpreter's own 5 ms make that a tenth of a second beside four of them."""
_COLLECTIONS = (2_000, 50, 1_000)
"""After so many new objects these are looked through, every 50th time older ones too, every 50,000th time all."""
logger = logging.getLogger(__name__)


class Server(uvicorn.Server):
    """Serves one application on sockets that it is given. Slow clients are for the proxy in front."""

    def __init__(self, settings: Settings) -> None:
        raise_descriptor_limit()
        config = uvicorn.Config(
            lambda: create_app(settings),
            factory=True,
            http="h11",
            ws="none",
            timeout_keep_alive=_IDLE_S,
            h11_max_incomplete_event_size=_MOST_HEAD_BYTES,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,  # any client on loopback could choose the address that its requests count for
            lifespan="on",
            timeout_graceful_shutdown=_DRAIN_S,
        )
        super().__init__(config)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        sys.setswitchinterval(_SWITCH_S)
        _collect_seldom()


def raise_descriptor_limit() -> None:
    """Allow this process as many open files as the system does, up to a number that is enough."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _MOST_DESCRIPTORS)
    if resource.RLIM_INFINITY != soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _collect_seldom() -> None:
    """Thousands of connections are many objects: each full garbage collection stops every answer for 0.2 to 0.5 s.

    What is loaded by now stays for good and is left out.
    """
    gc.freeze()
    gc.set_threshold(*_COLLECTIONS)
    gc.enable()
