"""Counting what a test sends to Redis."""

from __future__ import annotations

from typing import Any

import pytest
from redis import Redis
from redis.client import Pipeline


def counted_round_trips(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What this process sends to Redis from now on: an entry a round trip, a command's name or "pipeline"."""
    sent: list[str] = []
    command: Any = Redis.execute_command
    pipeline: Any = Pipeline.execute

    def execute_command(self: Redis, *arguments: Any, **options: Any) -> Any:
        sent.append(str(arguments[0]))
        return command(self, *arguments, **options)

    def execute(self: Pipeline, raise_on_error: bool = True) -> Any:
        sent.append("pipeline")
        return pipeline(self, raise_on_error)

    monkeypatch.setattr(Redis, "execute_command", execute_command)
    monkeypatch.setattr(Pipeline, "execute", execute)
    return sent
