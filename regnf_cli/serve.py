"""``regnf serve``: the service on this machine, with everything it needs; ``regnf worker``: one more worker."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from regnf_cli.guard import require
from regnf_core.errors import InvalidInputError

_PACKAGED = Path(__file__).with_name("demo_files")
_CHECKOUT = Path(__file__).resolve().parents[1] / "examples" / "data"
FILES = ("mix-room.safetensors", "armchair.safetensors", "detection.json", "truth.json")
"""What the demo needs; the build of the wheel copies these files into the package."""


def serve(
    host: Annotated[str | None, typer.Option(help="Address on which the service listens. [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port; 0 chooses a free port. [default: 8080]")
    ] = None,
    state_dir: Annotated[
        Path | None, typer.Option(help="Folder for fields, results and records. [default: ~/.local/state/regnf]")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=0, max=64, help="Number of worker processes. [default: 1]")] = None,
) -> None:
    """Run the HTTP service and its web page, with workers and a private Redis.

    Other settings come from the environment variables REGNF_*. Ctrl+C stops everything.

    Example: **regnf serve --port 8080**
    """
    require("service")
    from regnf_cli.supervisor import Supervisor
    from regnf_state.logs import configure_logging
    from regnf_state.settings import read_settings

    settings = read_settings(host=host, port=port, state_dir=state_dir, workers=workers)
    if settings.workers:
        require("engine")  # a worker starts without it, and then fails every job
    if settings.demo_dir is None:
        settings = settings.model_copy(update={"demo_dir": demo_folder()})
    configure_logging(settings.log_format)
    Supervisor(settings).run(ready=lambda address: typer.echo(f"regnf serves {address} (Ctrl+C stops it)"))


def worker(
    redis_url: Annotated[
        str | None, typer.Option(help="Address of the service's Redis. [default: REGNF_REDIS_URL]", show_default=False)
    ] = None,
) -> None:
    """Run jobs from the service's queue until it is stopped. A running job is then put back into the queue.

    It needs the service's Redis and its storage (REGNF_STORAGE_URL, or the same REGNF_STATE_DIR). Other settings come
    from the environment variables REGNF_*.

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
        message = "no address of a Redis: neither --redis-url nor REGNF_REDIS_URL is given"
        hint = "Give --redis-url redis://HOST:6379/0, or use `regnf serve`, which starts its own Redis and worker."
        raise StartError(message, reason=error.reason, hint=hint) from error
    except (PreloadError, StorageMismatchError) as error:
        raise StartError(str(error), reason=error.reason) from error
    except (RedisConnectionError, RedisTimeoutError) as error:
        hint = "Start Redis, or check its address in --redis-url or REGNF_REDIS_URL."
        raise StartError(f"Redis does not answer: {error}", reason="REDIS_UNAVAILABLE", hint=hint) from error


def demo_folder() -> Path:
    """The folder that holds all of ``FILES``. Raises InvalidInputError (DEMO_DATA_MISSING)."""
    for folder in (_PACKAGED, _CHECKOUT):
        if all((folder / name).is_file() for name in FILES):
            return folder
    raise InvalidInputError(
        f"the demo's files ({', '.join(FILES)}) were not found in {_PACKAGED} or {_CHECKOUT}; install regnf from its "
        f"wheel, or run it from a checkout",
        reason="DEMO_DATA_MISSING",
    )


if __name__ == "__main__":
    typer.run(serve)
