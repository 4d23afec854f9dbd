"""One process that the supervisor keeps running."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence

_STDERR = 2
"""Where children write: standard output is for the one line that tells the address."""
_FIRST_PAUSE_S = 0.5
_LONGEST_PAUSE_S = 10.0
_STEADY_AFTER_S = 30.0
logger = logging.getLogger(__name__)


class Child:
    """A command, which ends with this process and is restarted after growing pauses whenever it ends.

    Start it from the main thread: the kernel ties its life to the thread that started it. ``lifeline`` is the reading
    end of a pipe that nobody writes to; ``passed`` are descriptors that the command inherits.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        lifeline: int,
        passed: Sequence[int] = (),
    ) -> None:
        self.name = name
        self._command = [sys.executable, "-m", "regnf_cli.guard", str(os.getpid()), str(lifeline), *command]
        self._environment = dict(environment)
        self._passed = (lifeline, *passed)
        self._process: subprocess.Popen[bytes] | None = None
        self._started = 0.0
        self._pause_s = _FIRST_PAUSE_S
        self._start_at = 0.0

    def start(self) -> None:
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
    def exit_status(self) -> int | None:
        """None while it runs, and before it has been started."""
        return self._process.poll() if self._process is not None else None

    def keep_running(self) -> None:
        """Restart it when it has ended and its pause is over."""
        if self._process is None or self._process.poll() is None:
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
            self.start()

    def ask_to_stop(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most this long; then it is killed."""
        if self._process is None:
            return
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            logger.warning("%s does not stop: killed", self.name)
            self._process.kill()
            self._process.wait()
