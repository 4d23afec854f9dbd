"""Dataclasses that pydantic reads from documents, and that have no members but their own."""

from __future__ import annotations

from typing import Any, ClassVar


class Closed:
    """Base of a dataclass: pydantic refuses members that it does not know."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}
