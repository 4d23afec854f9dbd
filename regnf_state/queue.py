"""The transport to the workers. A job's only argument is an id; what it must do is in its record."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from regnf_state.ownership import ANONYMOUS
from regnf_state.records import JobRecord

QUEUE_NAME = "regnf"
IMPORT_QUEUE_NAME = "regnf-import"
REGISTER_FUNCTION = "regnf_worker.jobs.run_registration"
IMPORT_FUNCTION = "regnf_worker.jobs.run_import"

Kind = Literal["import", "registration"]
"""What the transport tells apart. A "registration" is a job of any kind: its record says which."""
_ATTEMPT = r"(?P<attempt>[1-9][0-9]{0,8})"
_NAMES: dict[Kind, re.Pattern[str]] = {
    "import": re.compile(rf"import-(?P<argument>[0-9a-f]{{64}}(?:_[a-z0-9][a-z0-9-]{{0,31}})?)-{_ATTEMPT}"),
    "registration": re.compile(rf"(?P<argument>[A-Za-z0-9_-]{{1,100}})-{_ATTEMPT}"),
}


@dataclass(frozen=True)
class Work:
    """One attempt at a job (``argument`` is its id) or at an import (a field's reference)."""

    kind: Kind
    argument: str
    attempt: int

    @property
    def name(self) -> str:
        """What the transport calls it."""
        prefix = "import-" if self.kind == "import" else ""
        return f"{prefix}{self.argument}-{self.attempt}"

    @property
    def function(self) -> str:
        return IMPORT_FUNCTION if self.kind == "import" else REGISTER_FUNCTION

    @property
    def queue_name(self) -> str:
        return IMPORT_QUEUE_NAME if self.kind == "import" else QUEUE_NAME

    @classmethod
    def named(cls, queue_name: str, name: str) -> Work:
        """The work of this name in the queue. Raises ValueError when no work of that queue has such a name."""
        kind: Kind = "import" if queue_name == IMPORT_QUEUE_NAME else "registration"
        match = _NAMES[kind].fullmatch(name)
        if match is None:
            raise ValueError("not a name of this queue")
        return cls(kind, match["argument"], int(match["attempt"]))


class JobQueue(Protocol):
    """Hands ids to workers, each at most once per attempt: enqueueing what is known already changes nothing.

    Callers take turns by the time that their work has cost the workers.
    """

    def enqueue_registration(self, job_id: str, attempt: int, owner: str = ANONYMOUS, of_batch: bool = False) -> None:
        """of_batch: it waits behind all that its owner has posted by itself, so that a batch holds nothing up."""
        ...

    def enqueue_jobs(self, jobs: Sequence[JobRecord]) -> None:
        """The same for several accepted jobs, in one round trip, in their order."""
        ...

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        """Its owner is named in the field's reference."""
        ...

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        """Whether the transport still knows of this attempt, waiting or running."""
        ...

    def holds_import(self, sha256: str, attempt: int) -> bool: ...

    def stop(self, job_id: str, attempt: int) -> None:
        """Take a waiting job out of the queue, or tell the worker to end a running one."""
        ...

    def drop_import(self, sha256: str, attempt: int) -> None:
        """Take a waiting import out of the queue: its field is gone. One that runs goes on, and finds that itself."""
        ...

    def turn(self) -> None:
        """Hand the next in turn to the workers, if a process died before it did so."""
        ...

    def awaited(self) -> list[str]:
        """The fields whose import registrations wait for, off the queue."""
        ...

    def release(self, reference: str) -> None:
        """Queue what waited for this field: its import has ended."""
        ...

    def position(self, work: Work) -> int | None:
        """1 for the work that is expected to be next; None for what does not wait in line."""
        ...

    def spent(self, owner: str) -> dict[int, float]:
        """The worker seconds of an owner in the last hour, by minute (of the epoch)."""
        ...

    def live_workers(self) -> int:
        """How many workers have reported lately."""
        ...
