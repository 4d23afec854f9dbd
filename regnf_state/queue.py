"""What the queue hands to the workers: a name, whose record says what is to be done."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["import", "registration"]
"""What the queue tells apart. A "registration" is a job of any kind: its record says which."""
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
        """What the queue calls it."""
        prefix = "import-" if self.kind == "import" else ""
        return f"{prefix}{self.argument}-{self.attempt}"

    @classmethod
    def named(cls, kind: Kind, name: str) -> Work:
        """The work of this kind and name. Raises ValueError when no such work has such a name."""
        match = _NAMES[kind].fullmatch(name)
        if match is None:
            raise ValueError("not a name of this queue")
        return cls(kind, match["argument"], int(match["attempt"]))
