"""Content-Range of a request (RFC 9110, 14.4 and 14.5): which piece of a file the body is."""

from __future__ import annotations

import re

from regnf_service.fields.piecewise import PieceRange
from regnf_service.problem import CLOSE, Problem

PATTERN = r"^bytes ([0-9]{1,15}-[0-9]{1,15}|\*)/[0-9]{1,15}$"
_RANGE = re.compile(r"bytes (?:([0-9]{1,15})-([0-9]{1,15})|\*)/([0-9]{1,15})", re.ASCII | re.IGNORECASE)


def content_range(header: str | None, limit: int) -> PieceRange | None:
    """What the header says; None without one. Raises Problem INVALID_HEADER, UPLOAD_TOO_LARGE, UPLOAD_EMPTY."""
    if header is None:
        return None
    match = _RANGE.fullmatch(header.strip())
    if match is None:
        detail = "Content-Range is not `bytes first-last/total` or `bytes */total`."
        raise Problem("INVALID_HEADER", detail, headers=CLOSE)
    first, last, total = (None if text is None else int(text) for text in match.groups())
    assert total is not None
    if total > limit:
        raise Problem("UPLOAD_TOO_LARGE", f"At most {limit} bytes are taken.", headers=CLOSE)
    if total == 0:
        raise Problem("UPLOAD_EMPTY", headers=CLOSE)
    if first is None or last is None:
        return PieceRange(None, None, total)
    if not first <= last < total:
        raise Problem("INVALID_HEADER", "Content-Range names bytes beyond the file's end, or none.", headers=CLOSE)
    return PieceRange(first, last + 1, total)
