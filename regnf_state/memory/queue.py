"""A queue in memory."""

from __future__ import annotations


class InMemoryJobQueue:
    """A JobQueue that only notes what it was told; tests read ``registrations``, ``imports`` and ``stopped``."""

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers
        self.registrations: list[tuple[str, int]] = []
        self.imports: list[tuple[str, int]] = []
        self.stopped: list[tuple[str, int]] = []

    def enqueue_registration(self, job_id: str, attempt: int) -> None:
        if (job_id, attempt) not in self.registrations:
            self.registrations.append((job_id, attempt))

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        if (sha256, attempt) not in self.imports:
            self.imports.append((sha256, attempt))

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        return (job_id, attempt) in self.registrations

    def holds_import(self, sha256: str, attempt: int) -> bool:
        return (sha256, attempt) in self.imports

    def stop(self, job_id: str, attempt: int) -> None:
        self.stopped.append((job_id, attempt))
        if (job_id, attempt) in self.registrations:
            self.registrations.remove((job_id, attempt))

    def live_workers(self) -> int:
        return self.workers
