"""All connections of a server: how many there may be, and how long each may keep the server waiting.

A connection is either served, or the server waits for its client: for a head, for a body, or until the client reads.
Such a client has a time by which it must be done, the later the more bytes it moves; then the connection is closed.
Where there is no room for a new one, the address with the most connections loses the one that is due first. Where more
bytes of answers wait to be read than may, the caller that has most of them loses the one that has read nothing longest.
"""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import math
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import Protocol

_SWEEP_EVERY_S = 1.0
_RANKING_SHARE = 0.1
"""Of the time at most. Sorting thousands for each new connection would be a way to keep the server busy."""
_IPV6_SITE = 64
_GARBAGE_SHARE = 8
_COLLECT_AFTER_S = 0.05
"""Until the calls of the connections that were lost have come to their end."""


@dataclass(frozen=True)
class ClientClock:
    """head_s: for a request's head · stall_s: for a client that moves nothing · bytes_per_s: how fast it has to be."""

    head_s: float
    stall_s: float
    bytes_per_s: float

    def due(self, since: float, moved: int) -> float:
        """By when a client must be done that has moved so many bytes of a body or of an answer."""
        return since + self.stall_s + moved / self.bytes_per_s


class Guarded(Protocol):
    """A connection as it is watched."""

    site: str

    def due(self) -> float:
        """The loop's time by which its client must be done; infinite while it is served."""
        ...

    def must_make_room_by(self) -> float:
        """The same if another connection has no place. Who is due first has to go."""
        ...

    def has_sent(self) -> bool:
        """Whether something of its client waits to be read."""
        ...

    def stuck_since(self) -> float:
        """The loop's time since when its client has read nothing, if something waits to be read."""
        ...

    def end(self, *, politely: bool) -> None:
        """Close it, with an answer if one can be given."""
        ...


def site_of(host: str) -> str:
    """What counts as one address: IPv6 gives each network of 64 bits to somebody."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4 or address.ipv4_mapped is not None:
        return str(getattr(address, "ipv4_mapped", None) or address)
    return str(ipaddress.ip_network((address, _IPV6_SITE), strict=False))


class Connections:
    """For one event loop: ``most`` in all, ``most_of_site`` of an address, ``most_unread`` bytes of unread answers,
    of which a caller has a quarter at most."""

    def __init__(self, most: int, most_of_site: int, most_unread: int) -> None:
        self._most = most
        self._most_of_site = most_of_site
        self._most_unread = most_unread
        self._unread: dict[Guarded, tuple[str, int]] = {}
        self._unread_of: Counter[str] = Counter()
        self._abandoned = 0
        self._open: set[Guarded] = set()
        self._of_site: Counter[str] = Counter()
        self._ranked: dict[str, list[Guarded]] = {}
        self._next_ranking = 0.0
        self._sweep: asyncio.TimerHandle | None = None
        self.ended: Counter[str] = Counter()
        """How many were refused or closed, by the cause."""

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, one: Guarded) -> bool:
        """Take it in, if need be in place of another. False: there is no room, close it."""
        site = one.site
        if self._of_site[site] >= self._most_of_site and not self._make_room(site, "address"):
            return False
        if len(self._open) >= self._most and not self._make_room(self._of_site.most_common(1)[0][0], "all"):
            return False
        self._open.add(one)
        self._of_site[site] += 1
        if self._sweep is None:
            self._sweep = asyncio.get_running_loop().call_later(_SWEEP_EVERY_S, self._look)
        return True

    def remove(self, one: Guarded) -> None:
        """It has ended. What its client has not read is freed soon.

        A call that is cut off leaves circles of references, through tracebacks, that hold pieces of its answer. Nothing
        else would start a garbage collection for few large objects.
        """
        if one in self._open:
            self._open.remove(one)
            self._of_site[one.site] -= 1
            if not self._of_site[one.site]:
                del self._of_site[one.site]
        self._abandoned += self._unread.get(one, ("", 0))[1]
        self._forget_unread(one)
        if self._abandoned > self._most_unread // _GARBAGE_SHARE:
            self._abandoned = 0
            asyncio.get_running_loop().call_later(_COLLECT_AFTER_S, gc.collect)

    def note_unread(self, one: Guarded, who: str, size: int) -> None:
        """So many bytes of an answer to a call of ``who`` wait until the client of ``one`` reads them."""
        self._forget_unread(one)
        if not size:
            return
        self._unread[one] = who, size
        self._unread_of[who] += size
        while self._unread_of[who] > self._most_unread // 4:
            self._end_unread(who)
        while self._unread_of.total() > self._most_unread:
            self._end_unread(self._unread_of.most_common(1)[0][0])

    def _forget_unread(self, one: Guarded) -> None:
        who, size = self._unread.pop(one, ("", 0))
        self._unread_of[who] -= size
        if not self._unread_of[who]:
            del self._unread_of[who]

    def _end_unread(self, who: str) -> None:
        of_caller = (one for one, (owner, _) in self._unread.items() if owner == who)
        self.ended["unread"] += 1
        self._end(min(of_caller, key=lambda one: one.stuck_since()), politely=False)

    def shed(self, count: int) -> None:
        """Close so many that keep the server waiting, for want of descriptors."""
        for _ in range(count):
            if not self._of_site or not self._make_room(self._of_site.most_common(1)[0][0], "descriptors"):
                return

    def _make_room(self, site: str, cause: str) -> bool:
        self.ended[cause] += 1
        self._rank()
        candidates = self._ranked.get(site, [])
        while candidates:
            one = candidates.pop()
            if one in self._open and one.must_make_room_by() < math.inf and not one.has_sent():
                self._end(one, politely=False)
                return True
        return False

    def _rank(self) -> None:
        """Who is due first stands last in the list of its address."""
        began = time.monotonic()
        if began < self._next_ranking:
            return
        ranked: dict[str, list[tuple[float, Guarded]]] = defaultdict(list)
        for one in self._open:
            if (due := one.must_make_room_by()) < math.inf:
                ranked[one.site].append((due, one))
        self._ranked = {
            site: [one for _, one in sorted(found, key=lambda pair: -pair[0])] for site, found in ranked.items()
        }
        ended = time.monotonic()
        self._next_ranking = ended + (ended - began) / _RANKING_SHARE

    def _look(self) -> None:
        """Close what is overdue."""
        loop = asyncio.get_running_loop()
        now = loop.time()
        for one in [one for one in self._open if one.due() <= now]:
            self.ended["slow"] += 1
            self._end(one, politely=True)
        self._sweep = loop.call_later(_SWEEP_EVERY_S, self._look) if self._open else None

    def _end(self, one: Guarded, *, politely: bool) -> None:
        if not politely:
            self.remove(one)
        one.end(politely=politely)
