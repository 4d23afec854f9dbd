"""Ending long answers when the process is told to stop.

The server waits for open connections before it ends the application, so an event stream that waits for the
application's end would never end. Hence we listen to the signals ourselves, and pass them on.
"""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stopping_on_signals(stopping: asyncio.Event) -> Iterator[None]:
    """Set ``stopping`` when SIGINT or SIGTERM arrives, before the earlier handler is called."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    loop = asyncio.get_running_loop()
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def listener(earlier: Any) -> Callable[[int, FrameType | None], None]:
        def listen(number: int, frame: FrameType | None) -> None:
            loop.call_soon_threadsafe(stopping.set)
            if callable(earlier):
                earlier(number, frame)

        return listen

    # a signal without a Python handler keeps its default, which ends the process anyway
    handled = [number for number in _SIGNALS if callable(before[number])]
    for number in handled:
        signal.signal(number, listener(before[number]))
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, before[number])
