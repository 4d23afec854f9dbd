"""The HTTP application. `create_app` is the factory that servers call; tests hand it their own stores."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from fastapi import Depends, FastAPI
from redis import Redis
from starlette.middleware import Middleware
from starlette.staticfiles import StaticFiles

from regnf_core import __version__
from regnf_service.http import problems
from regnf_service.http.contract import build_contract
from regnf_service.http.dependencies import Services
from regnf_service.http.middleware import RequestContext, TokenGate
from regnf_service.http.query import refuse_unknown_parameters
from regnf_service.http.rate_limits import RateGate, RateLimiter, RedisRateLimiter
from regnf_service.http.routes import fields, jobs, meta, pages, registrations, results, uploads
from regnf_service.http.tokens import Callers, read_callers
from regnf_service.lifespan import lifespan_of
from regnf_service.metrics import Measured, Metrics
from regnf_service.webhooks.service import webhooks_of
from regnf_state.blobs.base import BlobStore
from regnf_state.blobs.open import open_blobs
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.queue import JobQueue
from regnf_state.records import RecordStore
from regnf_state.redis.client import connect
from regnf_state.redis.queue import RqJobQueue
from regnf_state.settings import Settings

_STORAGE_WAIT_S = 10.0
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
    services, redis, limiter = _open(settings, records, blobs, queue, limiter)
    metrics = Metrics(services, redis)
    app = FastAPI(
        title="regnf",
        version=__version__,
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,
        lifespan=lifespan_of(services, redis, metrics),
        middleware=_middleware(settings, callers, metrics, limiter),
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
    settings: Settings, callers: Callers, metrics: Metrics, limiter: RateLimiter | None
) -> list[Middleware]:
    """What every request passes through, outermost first."""
    gate = Middleware(
        TokenGate,
        callers=callers,
        needs_token=settings.needs_token,
        allow_unauthenticated=settings.allow_unauthenticated or settings.published_on_loopback,
    )
    limits = [Middleware(RateGate, limiter=limiter)] if limiter is not None else []
    return [Middleware(RequestContext), Middleware(Measured, metrics=metrics), gate, *limits]


def _open(
    settings: Settings,
    records: RecordStore | None,
    blobs: BlobStore | None,
    queue: JobQueue | None,
    limiter: RateLimiter | None,
) -> tuple[Services, Redis | None, RateLimiter | None]:
    """The stores that were not given, over Redis, which is None if none is needed, and the storage of the settings."""
    needs_redis = records is None or queue is None
    if needs_redis and settings.redis_url is None:
        raise ConfigurationError("set REGNF_REDIS_URL, or start with `regnf serve`, which brings its own Redis")
    redis = connect(settings.redis_url) if needs_redis and settings.redis_url is not None else None
    blobs = blobs or open_blobs(settings, _STORAGE_WAIT_S)
    if redis is not None:
        records = records or JournaledRecordStore(redis, settings.retention_s, blobs)
        queue = queue or RqJobQueue(redis)
        if limiter is None and settings.calls_per_s:
            limiter = RedisRateLimiter(redis, settings.calls_per_s, settings.rate_limit_burst)
    assert records is not None, "given, or made just now"
    assert queue is not None, "given, or made just now"
    return Services(settings, records, blobs, queue, webhooks_of(settings, redis)), redis, limiter


def _include_routers(app: FastAPI, **how: Any) -> None:
    for router in _ROUTERS:
        app.include_router(router, dependencies=_STRICT, **how)
    for router in _LENIENT_ROUTERS:
        app.include_router(router, **how)
