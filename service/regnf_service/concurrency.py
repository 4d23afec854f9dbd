"""How many objects of a kind may go on at once in this process: of each caller, and of all together."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

from regnf_service.problem import RETRY_LATER, Problem

_LOOK_EVERY_S = 0.02
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")
_Item = TypeVar("_Item")
whose: ContextVar[str] = ContextVar("whose", default="")
"""Whom the work at hand is done for: a caller, without tokens an address; "" for the service itself."""


class _Lines:
    """Who waits for one of ``most`` places: a line for each caller, which has ``of_caller`` places at most."""

    def __init__(self, most: int, of_caller: int) -> None:
        self._free = most
        self._of_caller = of_caller
        self._taken: Counter[str] = Counter()
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()
        self.limiter = CapacityLimiter(most)

    async def take(self, who: str) -> None:
        """Return when a place is this caller's; give it back with ``give_back``."""
        if self._may_begin(who):
            self._begin(who)
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(who, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.give_back(who)
            raise

    def give_back(self, who: str) -> None:
        """Whose turn it is begins."""
        self._free += 1
        self._taken[who] -= 1
        if not self._taken[who]:
            del self._taken[who]
        while (whose_turn := next(filter(self._may_begin, self._waiting), None)) is not None:
            line = self._waiting.pop(whose_turn)
            turn = line.popleft()
            if line:
                self._waiting[whose_turn] = line  # behind all others
            if not turn.done():
                self._begin(whose_turn)
                turn.set_result(None)

    def _may_begin(self, who: str) -> bool:
        return self._free > 0 and self._taken[who] < self._of_caller

    def _begin(self, who: str) -> None:
        self._free -= 1
        self._taken[who] += 1


class Threads:
    """Threads for one kind of blocking work, ``most`` of them. Callers take turns, and none has all of them.

    All threads share one interpreter: a caller with many of them would slow those of others down, and the event loop.
    """

    def __init__(self, kind: str, most: int, of_caller: int) -> None:
        self._most = most
        self._of_caller = of_caller
        self._of_loop: RunVar[_Lines] = RunVar(f"{kind}_threads")

    async def run(self, work: Callable[..., _Result], *arguments: Any) -> _Result:
        """Run blocking work in one of them, when it is the turn of ``whose`` work it is."""
        lines = self._of_loop.get(None)
        if lines is None:
            lines = _Lines(self._most, self._of_caller)
            self._of_loop.set(lines)
        who = whose.get()
        await lines.take(who)
        try:
            return await to_thread.run_sync(work, *arguments, limiter=lines.limiter)
        finally:
            lines.give_back(who)


STORES = Threads("store", 40, 2)
"""Calls of stores. When all of them wait, what needs no store is still answered. Measured beside a caller with 60
connections that filter lists: with two threads of hers polls of others take 43 ms (p99), with four 100 to 200 ms, and
she is answered no less."""
PARSING = Threads("parsing", 2, 1)
"""Reading bodies, in portions: the interpreter's own work, of which two at once go no faster than one."""
UPLOADS = Threads("upload", 8, 2)
"""Hashing and writing uploads: a slow disk must not keep a poll waiting."""
LOOKS = Threads("look", 4, 1)
"""Looks for held answers: hundreds of them must not either."""
DRAWING = Threads("drawing", 1, 1)
"""Pictures of results: a tenth of a second each, in part the interpreter's own work."""
PROBES = Threads("probe", 4, 2)
"""Whether the service is ready: whoever asks does not wait behind its own requests."""
in_thread = STORES.run


def blocking(route: Callable[_Given, _Result]) -> Callable[_Given, Awaitable[_Result]]:
    """A route that calls stores, run in a thread of theirs. The framework would take one that everything shares."""

    @wraps(route)
    async def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        return await in_thread(partial(route, *args, **kwargs))

    return run


def portions(items: Iterable[_Item], size: Callable[[_Item], int], most: int, count: int) -> Iterator[list[_Item]]:
    """A few at a time, so that other callers' requests are served in between: of this size, or as many."""
    few: list[_Item] = []
    total = 0
    for item in items:
        few.append(item)
        total += size(item)
        if total >= most or len(few) == count:
            yield few
            few, total = [], 0
    if few:
        yield few


async def pause(seconds: float, stopping: asyncio.Event) -> bool:
    """Sleep, or less if the service stops. Returns whether it does."""
    try:
        async with asyncio.timeout(seconds):
            await stopping.wait()
    except TimeoutError:
        return False
    return True


class Slots:
    """At most ``most`` for each caller, of ``what``. For one thread."""

    def __init__(self, most: int, what: str) -> None:
        self._most = most
        self._what = what
        self._taken: Counter[str] = Counter()

    def take(self, caller: str, count: int = 1) -> None:
        """Take so many; give them back with ``free``. Raises Problem."""
        if self._taken[caller] + count > self._most:
            detail = f"At most {self._most} {self._what} at once are allowed. Wait until one of your own has ended."
            raise Problem("TOO_MANY_REQUESTS_AT_ONCE", detail, headers=RETRY_LATER)
        self._taken[caller] += count

    def free(self, caller: str, count: int = 1) -> None:
        self._taken[caller] -= count
        if not self._taken[caller]:
            del self._taken[caller]

    @contextmanager
    def held(self, caller: str, count: int = 1) -> Iterator[None]:
        """So many for as long as the context lasts. Raises Problem."""
        self.take(caller, count)
        try:
            yield
        finally:
            self.free(caller, count)

    async def emptied(self, seconds: float) -> None:
        """Wait until none is taken, at most this long."""
        deadline = time.monotonic() + seconds
        while self._taken and time.monotonic() < deadline:
            await asyncio.sleep(_LOOK_EVERY_S)

    @property
    def taken(self) -> int:
        """How many are taken by all callers together."""
        return self._taken.total()


class Waiters:
    """Answers that are held back. All of them together look for news ``looks_per_s`` times a second, however many;
    those of each caller as often as those of any other.

    Each keeps a connection in use: beyond ``most``, or half as many of one caller, no further one is held back.
    """

    def __init__(self, looks_per_s: float = 200.0, most: int = 1000) -> None:
        self._looks_per_s = looks_per_s
        self._most = most
        self._held: Counter[str] = Counter()

    def has_room(self, caller: str) -> bool:
        """Whether one more answer to this caller may be held back."""
        return self._held.total() < self._most and 2 * self._held[caller] < self._most

    @contextmanager
    def held(self, caller: str) -> Iterator[None]:
        """One answer is held while the block runs."""
        self._held[caller] += 1
        try:
            yield
        finally:
            self._held[caller] -= 1
            if not self._held[caller]:
                del self._held[caller]

    def pause_s(self, caller: str, wanted_s: float) -> float:
        """Seconds until one of this caller's looks again: what it would like, or more where the caller has many.

        Up to a quarter more or less, so that those that began together do not look together ever after.
        """
        share = self._looks_per_s / max(1, len(self._held))
        return max(wanted_s, self._held[caller] / share) * random.uniform(0.75, 1.25)  # noqa: S311


# The bytes of uploads that are under way: they count towards the caller's quota before they are stored.


class Claim:
    """The bytes of one request: as many as it declared, or as have arrived if these are more."""

    def __init__(self, claimed: Counter[str], caller: str, room: int | None) -> None:
        self._claimed = claimed
        self._caller = caller
        self._room = room
        self.arrived = 0
        self._held = 0

    def arrive(self, size: int) -> None:
        """Count bytes that came. Raises Problem QUOTA_STORED."""
        self.arrived += size
        self.hold(self.arrived)

    def hold(self, size: int) -> None:
        """Hold this many bytes at least. Raises Problem QUOTA_STORED."""
        more = size - self._held
        if more <= 0:
            return
        if self._room is not None and self._claimed[self._caller] + more > self._room:
            raise Problem("QUOTA_STORED")
        self._claimed[self._caller] += more
        self._held = size

    def end(self) -> None:
        """Hold nothing: the bytes are gone, or are about to count as stored."""
        self._claimed[self._caller] -= self._held
        self._held = 0
        if not self._claimed[self._caller]:
            del self._claimed[self._caller]


class UnderWay:
    """The bytes of all uploads under way in this process, by caller. For one thread."""

    def __init__(self) -> None:
        self._claimed: Counter[str] = Counter()

    @contextmanager
    def claim(self, caller: str, room: int | None, declared: int | None) -> Iterator[Claim]:
        """A claim for as long as the context lasts.

        All claims of a caller together have ``room`` bytes; None: no bound. Raises Problem QUOTA_STORED.
        """
        claim = Claim(self._claimed, caller, room)
        try:
            claim.hold(declared or 0)
            yield claim
        finally:
            claim.end()
