"""``regnf worker``: one more worker for a service that runs elsewhere."""

from __future__ import annotations

from typing import Annotated

import typer

from regnf_cli.guard import require


def worker(
    redis_url: Annotated[
        str | None, typer.Option(help="The service's Redis. [default: REGNF_REDIS_URL]", show_default=False)
    ] = None,
) -> None:
    """Take jobs from the service's queue until told to stop; a running job goes back to the queue.

    It needs the service's Redis and its storage (REGNF_STORAGE_URL, or the same REGNF_STATE_DIR). What is not given
    here is read from REGNF_*.

    Example: **regnf worker --redis-url redis://queue:6379/0**
    """
    require("service", "engine")
    import os

    from redis.exceptions import ConnectionError as RedisConnectionError
    from redis.exceptions import TimeoutError as RedisTimeoutError

    from regnf_cli.embedded_redis import StartError
    from regnf_state.journal.journal import StorageMismatchError
    from regnf_state.redis.client import NoRedisError
    from regnf_state.settings import check_redis_url, read_settings
    from regnf_worker.main import PreloadError, run_worker

    if redis_url is not None:
        check_redis_url(redis_url, "--redis-url")
        os.environ["REGNF_REDIS_URL"] = redis_url  # the jobs' processes read it there too
    try:
        run_worker(read_settings())
    except NoRedisError as error:
        message = "no Redis is named: neither --redis-url nor REGNF_REDIS_URL is given"
        hint = "Give --redis-url redis://HOST:6379/0, or start `regnf serve`, which brings its own Redis and worker."
        raise StartError(message, reason=error.reason, hint=hint) from error
    except (PreloadError, StorageMismatchError) as error:
        raise StartError(str(error), reason=error.reason) from error
    except (RedisConnectionError, RedisTimeoutError) as error:
        hint = "Start Redis, or check the address in --redis-url or REGNF_REDIS_URL."
        raise StartError(f"Redis does not answer: {error}", reason="REDIS_UNAVAILABLE", hint=hint) from error
