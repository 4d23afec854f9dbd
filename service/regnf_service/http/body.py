"""Reading a request's body ourselves: counted, timed, and never more than was allowed."""

from __future__ import annotations

from collections.abc import AsyncIterator

from starlette.requests import Request

from regnf_service.http.pace import Pace
from regnf_service.problem import CLOSE, Problem


def declared_length(request: Request, besides: int = 0) -> int | None:
    """The Content-Length less what may come ``besides`` files, None for a chunked body. Raises INVALID_HEADER."""
    text = request.headers.get("content-length")
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 19):
        raise Problem("INVALID_HEADER", "Content-Length is not a number of bytes.", headers=CLOSE)
    return max(0, int(text) - besides)


def refuse_encoding(request: Request) -> None:
    """Compressed bodies are not taken: their size would be a guess. Raises Problem UNSUPPORTED_MEDIA_TYPE."""
    if request.headers.get("content-encoding", "identity").strip().lower() != "identity":
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send the body without Content-Encoding.", headers=CLOSE)


def media_type(request: Request) -> str:
    """The Content-Type without its parameters, lower case; "" when there is none."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def chunks(request: Request, limit: int, pace: Pace, too_large: str = "UPLOAD_TOO_LARGE") -> AsyncIterator[bytes]:
    """The body as it arrives, at most ``limit`` bytes of it.

    Raises Problem: ``too_large`` by header or by count, UPLOAD_STALLED when its ``pace`` is too slow, UPLOAD_INCOMPLETE
    when the client leaves or the count is not what it declared.
    """
    declared = declared_length(request)
    if declared is not None and declared > limit:
        raise Problem(too_large, f"At most {limit} bytes are taken.", headers=CLOSE)
    received = 0
    more = True
    while more:
        message = await pace.next(request)
        if message["type"] == "http.disconnect":
            raise Problem("UPLOAD_INCOMPLETE", headers=CLOSE)
        data: bytes = message.get("body", b"")
        received += len(data)
        if received > limit:
            raise Problem(too_large, f"At most {limit} bytes are taken.", headers=CLOSE)
        if data:
            yield data
        more = message.get("more_body", False)
    if declared is not None and received != declared:
        raise Problem("UPLOAD_INCOMPLETE", headers=CLOSE)
