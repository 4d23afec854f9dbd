"""The whole service on one machine: Redis, workers and API as children of one process, which ends them all."""

from __future__ import annotations

import errno
import fcntl
import http.client
import itertools
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from regnf_cli.embedded_redis import StartError, address_of, answers, open_socket, server_command
from regnf_state.settings import SECRETS, Settings, variables

# One process that the supervisor keeps running.

_STDERR = 2
"""Where children write: standard output is for the one line that tells the address."""
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 10.0
_STEADY_AFTER_S = 30.0


class Child:
    """A command, which ends with this process and is restarted after growing pauses whenever it ends.

    Made in the main thread: the kernel ties its life to the thread that started it. ``passed``: descriptors that the
    command inherits · ``stop_s``: how long it may take to stop.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        stop_s: float,
        passed: Sequence[int] = (),
    ) -> None:
        self.name = name
        self.stop_s = stop_s
        self._command = [sys.executable, "-m", "regnf_cli.guard", str(os.getpid()), *command]
        self._environment = dict(environment)
        self._passed = tuple(passed)
        self._pause_s = _FIRST_PAUSE_S
        self._start_at = 0.0
        self._start()

    def _start(self) -> None:
        """Start the command in a session of its own: a terminal's Ctrl+C is for the supervisor alone."""
        self._started = time.monotonic()
        self._process = subprocess.Popen(
            self._command,
            env=self._environment,
            pass_fds=self._passed,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=_STDERR,
        )
        logger.info("%s started, process %d", self.name, self._process.pid)

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def keep_running(self) -> None:
        """Restart it when it has ended and its pause is over."""
        if self.is_running:
            return
        now = time.monotonic()
        if not self._start_at:
            if now - self._started > _STEADY_AFTER_S:
                self._pause_s = _FIRST_PAUSE_S
            logger.error("%s ended (%s); restarted in %.1f s", self.name, self._process.returncode, self._pause_s)
            self._start_at = now + self._pause_s
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        elif now >= self._start_at:
            self._start_at = 0.0
            self._start()

    def ask_to_stop(self) -> None:
        self._process.terminate()

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most this long; then it is killed."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            logger.warning("%s did not stop and was killed", self.name)
            self._process.kill()
            self._process.wait()


# One service for each state folder.

_NAME = "serve.lock"
_SOCKET_PREFIX = "regnf-"
_LEAST_FREE_BYTES = 1 << 20
"""What Redis and the storage write when they start takes some kilobytes."""


class StateLock:
    """Holds a state folder for one service, and records what the next one must remove if this one is killed.

    Raises StartError (STATE_DIR_IN_USE, STATE_DIR_UNUSABLE) on entry.
    """

    def __init__(self, state_dir: Path) -> None:
        self._state_dir = state_dir
        self._noted: dict[str, object] = {}
        self.socket_dir: Path | None = None

    def __enter__(self) -> StateLock:
        made = [folder for folder in (self._state_dir, *self._state_dir.parents) if not folder.exists()]
        try:
            self._state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock()
            _require_writable(self._state_dir)
            self._remove_leftover()
            self.note(pid=os.getpid())
        except OSError as error:
            with suppress(AttributeError, OSError):  # it may not have come to be
                self._file.close()
            _take_back(made)
            inside = error.filename is not None and Path(error.filename).is_relative_to(self._state_dir)
            detail = f"cannot keep state in {error.filename if inside else self._state_dir}: {error.strerror}"
            hint = "Give a writable folder with --state-dir."
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                hint = "Free space on the disk, or give a folder on another disk with --state-dir."
            raise StartError(detail, reason="STATE_DIR_UNUSABLE", hint=hint) from error
        return self

    def _lock(self) -> None:
        """Raises OSError, StartError (STATE_DIR_IN_USE)."""
        self._file = (self._state_dir / _NAME).open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            held = self._read()
            self._file.close()
            who = f" (process {held['pid']}, {held.get('address', 'not listening yet')})" if "pid" in held else ""
            detail = f"another `regnf serve`{who} uses {self._state_dir}"
            hint = "Use the running one, or stop it, or give this one its own folder with --state-dir."
            raise StartError(detail, reason="STATE_DIR_IN_USE", hint=hint) from error

    def __exit__(self, *_: object) -> None:
        if self.socket_dir is not None:
            shutil.rmtree(self.socket_dir, ignore_errors=True)
        with suppress(OSError):  # on a full disk the note stays: the lock itself is what counts
            self._write({})
        with suppress(OSError):
            self._file.close()

    def make_socket_dir(self) -> Path:
        """A private folder with a short path: socket paths hold about a hundred bytes, state folders may lie deep."""
        usual = tempfile.gettempdir()
        folder = Path(tempfile.mkdtemp(prefix=_SOCKET_PREFIX, dir=usual if len(usual) < 60 else "/tmp"))  # noqa: S108
        self.socket_dir = folder
        self.note(socket_dir=str(folder))
        return folder

    def note(self, **more: object) -> None:
        """Record more of this service: process, address, the folder of its socket."""
        self._noted |= more
        self._write(self._noted)

    def _write(self, content: Mapping[str, object]) -> None:
        self._file.seek(0)
        self._file.truncate()
        json.dump(content, self._file)
        self._file.flush()

    def _read(self) -> dict[str, object]:
        self._file.seek(0)
        try:
            content = json.loads(self._file.read() or "{}")
        except ValueError:
            return {}
        return content if isinstance(content, dict) else {}

    def _remove_leftover(self) -> None:
        left = Path(str(self._read().get("socket_dir", "")))
        if left.name.startswith(_SOCKET_PREFIX) and left.is_dir() and left.stat().st_uid == os.getuid():
            shutil.rmtree(left, ignore_errors=True)


def _require_writable(state_dir: Path) -> None:
    """Raises OSError for a folder of the service's, one within it, or a disk, that takes no more files."""
    inside = [folder for pattern in ("*/", "*/*/") for folder in state_dir.glob(pattern)]
    for folder in (state_dir, *inside):
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                if folder == state_dir:
                    os.posix_fallocate(file.fileno(), 0, _LEAST_FREE_BYTES)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(folder)) from error


def _take_back(made: list[Path]) -> None:
    """Remove the folders that a start has made, the innermost first, and nothing else."""
    with suppress(OSError):
        if made:
            (made[0] / _NAME).unlink(missing_ok=True)
        for folder in made:
            folder.rmdir()


# Before `regnf serve` starts its processes: is its storage the one whose records Redis holds?

_WAIT_S = 10.0


def check_storage(settings: Settings) -> None:
    """Raises StartError (STORAGE_MISMATCH). While Redis or the storage is away nobody can tell; the API looks again."""
    from redis.exceptions import RedisError

    from regnf_state.journal.journal import StorageMismatchError, claim_storage
    from regnf_state.stores import open_stores

    stores = open_stores(settings, retries=None, storage_wait_s=_WAIT_S)
    try:
        claim_storage(stores.redis, stores.records.journal.storage_id(), settings.adopt_storage or None)
    except StorageMismatchError as error:
        raise StartError(str(error), reason=error.reason) from error
    except (RedisError, OSError) as error:
        logger.warning("the owner of Redis's records is checked later: %s", type(error).__name__)
    finally:
        stores.redis.close()


_LOOK_EVERY_S = 0.2
_ASK_EVERY_S = 0.01
"""Of Redis, which takes some hundredths of a second. The API's socket is open before it: a request waits there."""
_START_DEADLINE_S = 60.0
_STOP_S = 10.0
"""For the API and for Redis; for workers after their own grace."""
_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
logger = logging.getLogger(__name__)


class Supervisor:
    """Starts the children, keeps them running, and stops them: the API first, Redis last.

    Run it in the main thread: signals arrive there, and the kernel ties the children's lives to it.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings.model_copy(update={"state_dir": settings.state_dir.resolve()})
        self._stop = threading.Event()
        self._signals = 0
        self._children: list[list[Child]] = []
        """Those that were started together, the first ones first."""

    def run(self, ready: Callable[[str], None]) -> None:
        """Serve until SIGTERM, SIGINT or SIGHUP. ``ready`` is called with the address once the service answers.

        Raises StartError when it cannot start; nothing is left running then either.
        """
        with ExitStack() as stack:
            stack.enter_context(self._handled_signals())
            lock = stack.enter_context(StateLock(self._settings.state_dir))
            listener = stack.enter_context(open_socket(self._settings))
            address = address_of(listener)
            lock.note(address=address)
            stack.callback(self._stop_children)
            url, redis = (self._settings.redis_url, None) if self._settings.redis_url else self._start_redis(lock)
            environment = self._environment(url, listener)
            workers: list[Child] = []  # they stop after the API
            self._children.append(workers)
            api = self._start_api(environment, listener)
            if redis is not None:
                self._until(lambda: answers(url), redis, "Redis")
            check_storage(self._settings.model_copy(update={"redis_url": url}))
            self._start_workers(workers, environment)
            if self._until(lambda: _api_answers(address), api, "the API"):
                ready(address)
            while not self._stop.wait(_LOOK_EVERY_S):
                for child in itertools.chain(*self._children):
                    child.keep_running()
            logger.info("stopping")

    def _start_redis(self, lock: StateLock) -> tuple[str, Child]:
        """Its address, at which it will answer, and its process."""
        path = lock.make_socket_dir() / "redis.sock"
        command = server_command(path, self._settings.state_dir / "redis")
        redis = Child("redis", command, _without_secrets(os.environ), _STOP_S)
        self._children.append([redis])
        return f"unix://{path}", redis

    def _environment(self, redis_url: str, listener: socket.socket) -> dict[str, str]:
        """What the API and the workers are told."""
        settings = self._settings
        return os.environ | variables(
            redis_url=redis_url,
            state_dir=settings.state_dir,
            host=settings.host,
            port=listener.getsockname()[1],
            workers=settings.workers,
            **({"demo_dir": settings.demo_dir} if settings.demo_dir is not None else {}),
        )

    def _start_api(self, environment: Mapping[str, str], listener: socket.socket) -> Child:
        """Started while Redis starts: by the time it has loaded, Redis answers."""
        descriptor = listener.fileno()
        command = [sys.executable, "-m", "regnf_cli.api_process", str(descriptor)]
        api = Child("api", command, environment, _STOP_S, passed=[descriptor])
        self._children.append([api])
        return api

    def _start_workers(self, workers: list[Child], environment: Mapping[str, str]) -> None:
        command, grace_s = [sys.executable, "-m", "regnf_worker.main"], self._settings.shutdown_grace_s + _STOP_S
        for number in range(1, self._settings.workers + 1):
            workers.append(Child(f"worker {number}", command, _without_secrets(environment), grace_s))

    def _until(self, look: Callable[[], bool], child: Child, what: str) -> bool:
        """Wait for a child to answer; False when a signal came first. Raises StartError when it ends or is late."""
        deadline = time.monotonic() + _START_DEADLINE_S
        while not self._stop.is_set():
            if look():
                return True
            if not child.is_running:
                raise StartError(f"{what} ended while it was starting; see the log above")
            if time.monotonic() > deadline:
                raise StartError(f"{what} did not start within {_START_DEADLINE_S:.0f} s")
            self._stop.wait(_ASK_EVERY_S)
        return False

    def _stop_children(self) -> None:
        """API first, so that nothing new comes in; then the workers, which give their jobs back; then Redis."""
        for together in reversed(self._children):
            for child in together:
                child.ask_to_stop()
            for child in together:
                child.wait(child.stop_s if self._signals < 2 else 0.0)

    @contextmanager
    def _handled_signals(self) -> Iterator[None]:
        def handle(*_: object) -> None:
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
