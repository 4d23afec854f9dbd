"""The bytes of uploads that are under way: they count towards the caller's quota before they are stored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from regnf_service.problem import CLOSE, Problem


class Claim:
    """The bytes of one request: as many as it declared, or as have arrived if these are more."""

    def __init__(self, claimed: Counter[str], caller: str, room: int | None) -> None:
        self._claimed = claimed
        self._caller = caller
        self._room = room
        self.arrived = 0
        self._held = 0

    def arrive(self, size: int) -> None:
        """Count bytes that came. Raises Problem QUOTA_STORED_BYTES."""
        self.arrived += size
        self.hold(self.arrived)

    def hold(self, size: int) -> None:
        """Hold this many bytes at least. Raises Problem QUOTA_STORED_BYTES."""
        more = size - self._held
        if more <= 0:
            return
        if self._room is not None and self._claimed[self._caller] + more > self._room:
            raise Problem("QUOTA_STORED_BYTES", headers=CLOSE)
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

        All claims of a caller together have ``room`` bytes; None: no bound. Raises Problem QUOTA_STORED_BYTES.
        """
        claim = Claim(self._claimed, caller, room)
        try:
            claim.hold(declared or 0)
            yield claim
        finally:
            claim.end()
