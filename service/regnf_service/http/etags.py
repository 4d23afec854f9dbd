"""Entity tags and `If-None-Match` (RFC 9110, sections 8.8.3 and 13.1.2)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header
from starlette.responses import Response

from regnf_state.records import FieldRecord

_TAG = re.compile(r'(?:W/)?("[\x21\x23-\x7e\x80-\xff]*")')
_LIST = re.compile(rf"[ \t,]*{_TAG.pattern}(?:[ \t]*,[ \t,]*{_TAG.pattern})*[ \t,]*")
_KEPT = ("etag", "cache-control", "retry-after")


@dataclass(frozen=True)
class IfNoneMatch:
    """The condition that a request sets. ``given`` is False without a condition, or with a malformed one."""

    given: bool = False
    tags: frozenset[str] | None = frozenset()
    """The opaque tags, with their quotes; None means `*`, any tag."""

    def matches(self, etag: str) -> bool:
        """Whether the client holds this version. The comparison is weak: proxies may put `W/` before a tag."""
        return self.given and (self.tags is None or etag.removeprefix("W/") in self.tags)

    def differs(self, etag: str) -> bool:
        """Whether the client holds another version."""
        return self.given and not self.matches(etag)

    def apply(self, answer: Response) -> Response:
        """The answer, or 304 with its headers when the client holds that version."""
        if not self.matches(answer.headers.get("etag", "")):
            return answer
        return Response(
            status_code=304, headers={name: answer.headers[name] for name in _KEPT if name in answer.headers}
        )


def parse_if_none_match(header: str | None) -> IfNoneMatch:
    """The condition in a header; a malformed header sets none."""
    if header is not None and header.strip() == "*":
        return IfNoneMatch(True, None)
    if header is None or not _LIST.fullmatch(header):
        return IfNoneMatch()
    return IfNoneMatch(True, frozenset(_TAG.findall(header)))


def field_etag(record: FieldRecord) -> str:
    """Changes with every change of the field's record."""
    return f'"{record.sha256[:16]}.{record.version}"'


async def _of_request(
    if_none_match: Annotated[
        str | None, Header(description="One or several ETags, or `*`: 304 when one of them is the current one.")
    ] = None,
) -> IfNoneMatch:
    return parse_if_none_match(if_none_match)


IfNoneMatchDep = Annotated[IfNoneMatch, Depends(_of_request)]
