"""Ways in which Redis refuses, and doubles that do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError

from regnf_worker.models import Context

FULL = OutOfMemoryError("command not allowed when used memory > 'maxmemory'.")
PASSING = [
    FULL,
    RedisConnectionError("Connection refused"),
    RedisTimeoutError("Timeout reading from socket"),
    ReadOnlyError("You can't write against a read only replica."),
    ResponseError("MISCONF Errors writing to the AOF file: No space left on device"),
    ResponseError("Command # 1 (HSET k v) of pipeline caused error: MISCONF Errors writing to the AOF file"),
    ResponseError("Error running script (call to f_0): @user_script:5: -OOM command not allowed"),
]
LASTING = ResponseError("WRONGTYPE Operation against a key holding the wrong kind of value")


class Refusals:
    """Raises the error the first ``count`` times that it is called; notes what it was called with."""

    def __init__(self, count: int, error: Exception = FULL, answer: object = None) -> None:
        self.left, self.error, self.answer = count, error, answer
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *arguments: Any) -> Any:
        self.calls.append(arguments)
        if self.left:
            self.left -= 1
            raise self.error
        return self.answer


def refuse(monkeypatch: pytest.MonkeyPatch, context: Context, name: str, count: int) -> None:
    """Have a store's method refuse the first ``count`` times."""
    store = context.records
    real: Callable[..., Any] = getattr(store, name)
    refusals = Refusals(count)

    def refusing(*arguments: Any, **changes: Any) -> Any:
        refusals()
        return real(*arguments, **changes)

    monkeypatch.setattr(store, name, refusing)


class RefusingRedis(Redis):
    """Refuses its ``refuse_at``-th command, counted from zero, instead of sending it."""

    sent = 0
    refuse_at = -1
    error: Exception = FULL
    refused: tuple[Any, ...] = ()

    def count(self, *command: Any) -> None:
        self.sent += 1
        if self.sent - 1 == self.refuse_at:
            self.refused = command
            raise self.error

    def execute_command(self, *arguments: Any, **options: Any) -> Any:
        self.count(*arguments)
        return super().execute_command(*arguments, **options)

    def pipeline(self, *arguments: Any, **options: Any) -> Any:
        pipeline = super().pipeline(*arguments, **options)
        execute = pipeline.execute

        def counted(raise_on_error: bool = True) -> Any:
            self.count("PIPELINE")
            return execute(raise_on_error)

        pipeline.execute = counted  # type: ignore[method-assign]
        return pipeline
