"""The HTTP application. `create_app` is the factory that servers call; tests hand it their own stores."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from fastapi import Depends, FastAPI
from starlette.middleware import Middleware
from starlette.staticfiles import StaticFiles

from regnf_core import __version__
from regnf_service.http import problems
from regnf_service.http.buckets import Buckets
from regnf_service.http.connections import Connections
from regnf_service.http.contract import build_contract
from regnf_service.http.cross_origin import cors_layer, cors_origins
from regnf_service.http.hosts import allowed_hosts
from regnf_service.http.middleware import RequestContext, TokenGate
from regnf_service.http.origin_gate import OriginGate
from regnf_service.http.query import refuse_unknown_parameters
from regnf_service.http.rate_limits import RateGate, RateLimiter, RedisRateLimiter
from regnf_service.http.routes import LENIENT_ROUTERS, ROUTERS
from regnf_service.http.turns import RequestGate, TurnGate
from regnf_service.http.write_limits import WriteGate
from regnf_service.lifespan import lifespan_of
from regnf_service.metrics import Measured, Metrics
from regnf_service.services import Services
from regnf_service.tokens import Callers, read_callers
from regnf_service.webhooks.service import webhooks_of
from regnf_state.settings import Settings
from regnf_state.stores import Stores, open_stores

_STORAGE_WAIT_S = 10.0
_STRICT = [Depends(refuse_unknown_parameters)]


def create_app(
    settings: Settings | None = None,
    stores: Stores | None = None,
    limiter: RateLimiter | None = None,
    connections: Connections | None = None,
) -> FastAPI:
    """The application over the given stores, or over those that the settings name; ``connections`` are its server's.

    Raises NoRedisError when no Redis is named, TokensError when the tokens are unusable, HostsError likewise.
    """
    settings = settings or Settings()
    callers = read_callers(settings.api_tokens, settings.api_tokens_file)
    stores = stores or open_stores(settings, retries=None, storage_wait_s=_STORAGE_WAIT_S)
    if limiter is None and settings.calls_per_s:
        limiter = RedisRateLimiter(stores.redis, settings.calls_per_s, settings.rate_limit_burst)
    webhooks = webhooks_of(settings, stores.redis)
    services = Services(settings, stores.redis, stores.records, stores.blobs, stores.queue, webhooks)
    metrics = Metrics(services, connections)
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
    if settings.writes_per_s:
        limits.append(Middleware(WriteGate, buckets=Buckets(settings.writes_per_s, settings.write_limit_burst)))
    if limiter is not None:
        limits.append(Middleware(RateGate, limiter=limiter))
    origins = cors_origins(settings)
    hosts = Middleware(OriginGate, hosts=allowed_hosts(settings), origins=origins)
    turns = Middleware(TurnGate, callers=callers if settings.needs_token else {})
    return [
        Middleware(RequestContext),
        Middleware(Measured, metrics=metrics),
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
