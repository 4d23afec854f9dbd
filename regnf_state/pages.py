"""Pages of a list of records, newest first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

_Record = TypeVar("_Record")
Position = tuple[float, str]
"""(created, name) of a record in a list."""

LOOKED_AT = 200
"""The most records that one page is chosen from: a filter that finds nothing takes a hundredth of a second a page."""
PAGE_BYTES = 512 * 1024
"""The most bytes of records that one page is chosen from, unless its first record alone has more. An answer has hardly
more than the records that it shows."""


@dataclass(frozen=True)
class Page(Generic[_Record]):
    """Records of a list, and the position after which the next page begins; None when this is the last.

    A page may hold fewer records than were asked for, or none, and not be the last.
    """

    records: list[_Record]
    rest: Position | None


def all_of(page_after: Callable[[Position | None], Page[_Record]]) -> Iterator[_Record]:
    """All records of a list, page by page."""
    rest: Position | None = None
    while True:
        page = page_after(rest)
        yield from page.records
        rest = page.rest
        if rest is None:
            return
