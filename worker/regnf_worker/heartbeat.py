"""A job's heartbeat, which also tells the job when it must stop."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from types import TracebackType
from typing import Any

from redis.exceptions import RedisError

from regnf_core.errors import CancelledError
from regnf_state.record_store import RecordStore
from regnf_state.records import JobRecord, StaleAttemptError
from regnf_worker.retry import retry_until_available

STOP_WITHIN_S = 5.0
_REPORT_EVERY_S = 0.25
_LAST_WORD_S = 1.0
"""A heartbeat that is on its way when the job ends has this long to arrive."""
logger = logging.getLogger(__name__)


class Heartbeat:
    """Beats in a thread of its own while the job runs, and writes the job's progress to its record.

    Use as a context manager. ``report`` is the registration's progress callback: it raises CancelledError once the job
    was cancelled or another attempt has taken over (``superseded``). A job that does not come back to ``report`` within
    five seconds of that is killed: native code receives no exception.
    """

    def __init__(self, records: RecordStore, job_id: str, attempt: int, beat_s: float) -> None:
        self._records = records
        self._job_id = job_id
        self._attempt = attempt
        self._beat_s = beat_s
        self._ended = threading.Event()
        self._stop = threading.Event()
        self._phase: str | None = None
        self._reported = 0.0
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self.superseded = False

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(_LAST_WORD_S)

    def report(self, phase: str, progress: float) -> None:
        """Note phase and overall progress 0..1: every change of phase, the rest a few times a second."""
        self.check()
        now = time.monotonic()
        if phase == self._phase and now - self._reported < _REPORT_EVERY_S:
            return
        self._phase, self._reported = phase, now
        self._ask(lambda: self._records.update_job(self._job_id, self._attempt, phase=phase, progress=progress))
        self.check()

    def check(self) -> None:
        """Raises CancelledError when the job shall stop."""
        if self._stop.is_set():
            raise CancelledError("the job was cancelled" if not self.superseded else "another attempt has taken over")

    def confirm(self) -> None:
        """Ask the record, as soon as it answers, whether this attempt counts. Raises CancelledError, RedisError."""
        retry_until_available(
            f"the record of job {self._job_id}",
            lambda: self._note(self._records.heartbeat, self._job_id, self._attempt),
        )
        self.check()

    def _beat(self) -> None:
        while not self._ended.wait(self._beat_s):
            self._ask(lambda: self._records.heartbeat(self._job_id, self._attempt))
            if self._stop.is_set():
                if not self._ended.wait(STOP_WITHIN_S):
                    logger.warning("job %s attempt %d does not stop: killed", self._job_id, self._attempt)
                    os.kill(os.getpid(), signal.SIGKILL)
                return

    def _ask(self, change: Any) -> None:
        try:
            self._note(change)
        except RedisError as error:
            logger.warning("job %s attempt %d: Redis does not answer: %s", self._job_id, self._attempt, error)
        except MemoryError:
            logger.warning("job %s attempt %d: no memory is left for a heartbeat", self._job_id, self._attempt)

    def _note(self, change: Any, *arguments: Any) -> None:
        try:
            record: JobRecord = change(*arguments)
        except StaleAttemptError:
            self.superseded = True
            self._stop.set()
        else:
            if record.cancel_requested:
                self._stop.set()
