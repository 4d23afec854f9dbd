"""The transport to the workers. A job's only argument is an id; what it must do is in its record."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

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
