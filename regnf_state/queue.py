"""The transport to the workers. A job's only argument is an id; what it must do is in its record."""

from __future__ import annotations

from typing import Protocol

QUEUE_NAME = "regnf"
IMPORT_QUEUE_NAME = "regnf-import"
"""Workers empty this one first: registrations wait for imports, never the other way round."""
REGISTER_FUNCTION = "regnf_worker.jobs.run_registration"
IMPORT_FUNCTION = "regnf_worker.jobs.run_import"


class JobQueue(Protocol):
    """Hands ids to workers, each at most once per attempt: enqueueing what is known already changes nothing."""

    def enqueue_registration(self, job_id: str, attempt: int) -> None: ...

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None: ...

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        """Whether the transport still knows of this attempt, waiting or running."""
        ...

    def holds_import(self, sha256: str, attempt: int) -> bool: ...

    def stop(self, job_id: str, attempt: int) -> None:
        """Take a waiting job out of the queue, or tell the worker to end a running one."""
        ...

    def live_workers(self) -> int:
        """How many workers have reported lately."""
        ...
