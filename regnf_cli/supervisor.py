"""The whole service on one machine: Redis, workers and API as children of one process, which ends them all."""

from __future__ import annotations

import http.client
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import FrameType
from urllib.parse import urlsplit

from regnf_cli.child import Child
from regnf_cli.embedded_redis import answers, server_command
from regnf_cli.listening import address_of, open_socket
from regnf_cli.start_errors import StartError
from regnf_cli.state_lock import StateLock
from regnf_cli.storage_check import check_storage
from regnf_state.settings import SECRETS, Settings

_LOOK_EVERY_S = 0.2
_START_DEADLINE_S = 60.0
_STOP_API_S = 10.0
_STOP_WORKER_MARGIN_S = 10.0
_STOP_REDIS_S = 10.0
_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
logger = logging.getLogger(__name__)


class Supervisor:
    """Starts the children in their order, keeps them running, and stops them in the opposite order.

    Run it in the main thread: signals arrive there, and the kernel ties the children's lives to it.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings.model_copy(update={"state_dir": settings.state_dir.resolve()})
        self._stop = threading.Event()
        self._signals = 0
        self._redis: Child | None = None
        self._api: Child | None = None
        self._workers: list[Child] = []

    def run(self, ready: Callable[[str], None]) -> None:
        """Serve until SIGTERM, SIGINT or SIGHUP. ``ready`` is called with the address once the service answers.

        Raises StartError when it cannot start; nothing is left running then either.
        """
        with ExitStack() as stack:
            stack.enter_context(self._handled_signals())
            lock = stack.enter_context(StateLock(self._settings.state_dir))
            listener = stack.enter_context(open_socket(self._settings))
            lock.note(address=address_of(listener))
            lifeline, held = os.pipe()
            stack.callback(os.close, held)
            stack.callback(os.close, lifeline)
            stack.callback(self._stop_children)
            url = self._settings.redis_url or self._start_redis(lock, lifeline)
            check_storage(self._settings.model_copy(update={"redis_url": url}))
            self._start_rest(url, listener, lifeline)
            if self._until(lambda: _api_answers(address_of(listener)), self._api, "the API"):
                ready(address_of(listener))
            while not self._stop.wait(_LOOK_EVERY_S):
                for child in self._children():
                    child.keep_running()
            logger.info("stopping")

    def _children(self) -> Iterator[Child]:
        """Those that run, in the order of their start."""
        if self._redis is not None:
            yield self._redis
        yield from self._workers
        if self._api is not None:
            yield self._api

    def _start_redis(self, lock: StateLock, lifeline: int) -> str:
        path = lock.make_socket_dir() / "redis.sock"
        command = server_command(path, self._settings.state_dir / "redis")
        self._redis = Child("redis", command, _without_secrets(os.environ), lifeline)
        self._redis.start()
        url = f"unix://{path}"
        self._until(lambda: answers(url), self._redis, "Redis")
        return url

    def _start_rest(self, redis_url: str, listener: socket.socket, lifeline: int) -> None:
        environment = os.environ | {
            "REGNF_REDIS_URL": redis_url,
            "REGNF_STATE_DIR": str(self._settings.state_dir),
            "REGNF_HOST": self._settings.host,
            "REGNF_PORT": str(listener.getsockname()[1]),
            "REGNF_WORKERS": str(self._settings.workers),
        }
        if self._settings.demo_dir is not None:
            environment["REGNF_DEMO_DIR"] = str(self._settings.demo_dir)
        descriptor = listener.fileno()
        api = [sys.executable, "-m", "regnf_cli.api_process", str(descriptor)]
        self._api = Child("api", api, environment, lifeline, passed=[descriptor])
        worker = [sys.executable, "-m", "regnf_worker.main"]
        self._workers = [
            Child(f"worker {number}", worker, _without_secrets(environment), lifeline)
            for number in range(1, self._settings.workers + 1)
        ]
        for child in (self._api, *self._workers):
            child.start()

    def _until(self, look: Callable[[], bool], child: Child | None, what: str) -> bool:
        """Wait for a child to answer; False when a signal came first. Raises StartError when it ends or is late."""
        deadline = time.monotonic() + _START_DEADLINE_S
        while not self._stop.is_set():
            if look():
                return True
            if child is not None and child.exit_status is not None:
                raise StartError(f"{what} ended while it was starting; the log above says why")
            if time.monotonic() > deadline:
                raise StartError(f"{what} did not start within {_START_DEADLINE_S:.0f} s")
            self._stop.wait(0.05)
        return False

    def _stop_children(self) -> None:
        """API first, so that nothing new comes in; then the workers, which give their jobs back; then Redis."""
        if self._api is not None:
            self._api.ask_to_stop()
            self._api.wait(self._patience(_STOP_API_S))
        for child in self._workers:
            child.ask_to_stop()
        for child in self._workers:
            child.wait(self._patience(self._settings.shutdown_grace_s + _STOP_WORKER_MARGIN_S))
        if self._redis is not None:
            self._redis.ask_to_stop()
            self._redis.wait(self._patience(_STOP_REDIS_S))

    def _patience(self, seconds: float) -> float:
        return seconds if self._signals < 2 else 0.0

    @contextmanager
    def _handled_signals(self) -> Iterator[None]:
        def handle(number: int, frame: FrameType | None) -> None:  # noqa: ARG001 - the signature is given
            self._signals += 1
            self._stop.set()

        before = {number: signal.signal(number, handle) for number in _SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _api_answers(address: str) -> bool:
    """Whether the API answers at all: what it says of its own health is for whoever asks it."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=2.0)
    try:
        connection.request("GET", "/healthz")
        connection.getresponse().read()
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
    return True


def _without_secrets(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment of a process that has no business with callers and their tokens."""
    return {name: value for name, value in environment.items() if name not in SECRETS}
