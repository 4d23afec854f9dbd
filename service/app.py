"""The HTTP application. `create_app` is the factory that servers call; tests hand it their own stores."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import Depends, FastAPI
from redis import Redis
from redis.exceptions import RedisError
from starlette.middleware import Middleware
from starlette.staticfiles import StaticFiles

from regnf_core import __version__
from service import problems
from service.blobs import BlobStore
from service.contract import build_contract
from service.dependencies import Services, off_loop
from service.housekeeping import Housekeeper
from service.journaled_records import JournaledRecordStore
from service.metrics import Measured, Metrics, served
from service.middleware import RequestContext, TokenGate
from service.query import refuse_unknown_parameters
from service.queue import JobQueue
from service.rate_limits import RateGate, RateLimiter, RedisRateLimiter
from service.reaper import Reaper
from service.rebuild import Rebuilder
from service.records import RecordStore
from service.redis_client import connect
from service.redis_queue import RqJobQueue
from service.routes import fields, jobs, meta, pages, registrations, results, uploads
from service.settings import Settings
from service.shutdown import stopping_on_signals
from service.storage import open_blobs
from service.tokens import read_callers
from service.waiting import pause
from service.webhooks.service import deliver_until_stopped, webhooks_of

logger = logging.getLogger(__name__)
_REAP_EVERY_S = 15.0
_CLEARING_UP_S = 5.0
_STORAGE_PATIENCE_S = 10.0
_STRICT = [Depends(refuse_unknown_parameters)]
_ROUTERS = (uploads.router, fields.router, registrations.router, jobs.router, results.router)
# links that people pass on and probes gather parameters that nobody meant
_LENIENT_ROUTERS = (pages.router, meta.router)


class ConfigurationError(RuntimeError):
    """The service cannot start as it is configured."""

    reason = "CONFIGURATION"


def create_app(
    settings: Settings | None = None,
    records: RecordStore | None = None,
    blobs: BlobStore | None = None,
    queue: JobQueue | None = None,
    limiter: RateLimiter | None = None,
) -> FastAPI:
    """The application over the given stores, or over Redis and the local folder that the settings name.

    Raises ConfigurationError when stores are missing and no Redis is named, TokensError when the tokens are unusable.
    """
    settings = settings or Settings()
    callers = read_callers(settings.api_tokens, settings.api_tokens_file)
    redis: Redis | None = None
    if records is None or queue is None:
        if settings.redis_url is None:
            raise ConfigurationError("set REGNF_REDIS_URL, or start with `regnf serve`, which brings its own Redis")
        redis = connect(settings.redis_url)
        blobs = blobs or open_blobs(settings, _STORAGE_PATIENCE_S)
        records = records or JournaledRecordStore(redis, settings.retention_s, blobs)
        queue = queue or RqJobQueue(redis)
        if limiter is None and settings.calls_per_s:
            limiter = RedisRateLimiter(redis, settings.calls_per_s, settings.rate_limit_burst)
    services = Services(
        settings, records, blobs or open_blobs(settings, _STORAGE_PATIENCE_S), queue, webhooks_of(settings, redis)
    )
    metrics = Metrics(services, redis)
    app = FastAPI(
        title="regnf",
        version=__version__,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,
        lifespan=_lifespan_of(services, redis, metrics),
        middleware=[
            Middleware(RequestContext),
            Middleware(Measured, metrics=metrics),
            Middleware(
                TokenGate,
                callers=callers,
                needs_token=settings.needs_token,
                allow_unauthenticated=settings.allow_unauthenticated,
            ),
            *([Middleware(RateGate, limiter=limiter)] if limiter is not None else []),
        ],
    )
    app.state.services = services
    app.state.metrics = metrics
    _include_routers(app)
    app.openapi = cache(lambda: build_contract(app))  # type: ignore[method-assign]
    _include_routers(app, prefix="/v1", include_in_schema=False)
    app.mount("/static", StaticFiles(directory=Path(__file__).with_name("web")), name="static")
    problems.install(app)
    return app


def _include_routers(app: FastAPI, **how: Any) -> None:
    for router in _ROUTERS:
        app.include_router(router, dependencies=_STRICT, **how)
    for router in _LENIENT_ROUTERS:
        app.include_router(router, **how)


def _lifespan_of(
    services: Services, redis: Redis | None, metrics: Metrics
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.openapi()  # takes a while, so not while somebody waits for an answer
        reaping = asyncio.create_task(_reap(services, redis)) if redis is not None else None
        delivering = asyncio.create_task(deliver_until_stopped(services, redis)) if redis is not None else None
        at = services.settings
        with served(metrics, at.metrics_host, at.metrics_port), stopping_on_signals(services.stopping):
            yield
        services.stopping.set()
        # the server has broken off what was still arriving, and does not wait for it to be cleared away
        await services.uploads.emptied(_CLEARING_UP_S)
        if delivering is not None:
            await delivering
        if reaping is not None:
            await reaping
        if redis is not None:
            redis.close()

    return lifespan


async def _reap(services: Services, redis: Redis) -> None:
    """Look after lost jobs every fifteen seconds until the service stops."""
    records, rebuilder, housekeeper = services.records, None, None
    if isinstance(records, JournaledRecordStore):
        rebuilder = Rebuilder(records, services.queue, services.blobs)
        housekeeper = Housekeeper(records, services.blobs, redis, services.settings)
    reaper = Reaper(records, services.queue, redis, services.settings, services.blobs, rebuilder, housekeeper)
    while not services.stopping.is_set():
        try:
            await off_loop(reaper.run_once)
        except (RedisError, OSError) as error:
            logger.warning("the reaper found a store away: %s", type(error).__name__)
        except Exception:
            logger.exception("a fault of ours ended the reaper's round; the next one comes")
        await pause(_REAP_EVERY_S, services.stopping)
