"""Reading a request's body ourselves: counted, and never more than was allowed."""

from __future__ import annotations

import email.message
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import ExitStack
from typing import Annotated, Protocol, TypeVar

from fastapi import Depends, Query
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser
from starlette.requests import Request

from regnf_service.concurrency import LOOKS, PARSING, in_thread, pause
from regnf_service.http.middleware import fair_key
from regnf_service.http.schemas.reading import read_model
from regnf_service.http.strict_json import MOST_VALUES
from regnf_service.problem import Problem
from regnf_service.services import Services

# What routes are given: the services, and the small readings of a request that several of them share.
#
# All are coroutines: the framework would run a plain function in a thread, which costs more than most answers.


async def services_of(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


async def prefix_of(request: Request) -> str:
    """What the caller's paths begin with: "" or "/v1", behind whatever a proxy put in front."""
    root = str(request.scope.get("root_path", ""))
    path = request.scope["path"].removeprefix(root)
    return root + ("/v1" if path == "/v1" or path.startswith("/v1/") else "")


async def caller_of_request(request: Request) -> str:
    """Whose call it is."""
    caller: str = request.state.caller
    return caller


ServicesDep = Annotated[Services, Depends(services_of)]
CallerDep = Annotated[str, Depends(caller_of_request)]
PrefixDep = Annotated[str, Depends(prefix_of)]
WaitQuery = Annotated[
    int, Query(ge=0, le=30, description="Longest time to wait for a change before the response is sent, seconds.")
]
LimitQuery = Annotated[int, Query(ge=1, le=200, description="Largest number of entries in the response.")]
PageTokenQuery = Annotated[str | None, Query(max_length=200, description="The `next_page_token` of the previous page.")]


def declared_length(request: Request, besides: int = 0) -> int | None:
    """The Content-Length less what may come ``besides`` files, None for a chunked body. Raises INVALID_HEADER."""
    text = request.headers.get("content-length")
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 19):
        raise Problem("INVALID_HEADER", "Content-Length is not a valid number of bytes.")
    return max(0, int(text) - besides)


def refuse_encoding(request: Request) -> None:
    """Compressed bodies are not taken: their size would be a guess. Raises Problem UNSUPPORTED_MEDIA_TYPE."""
    if request.headers.get("content-encoding", "identity").strip().lower() != "identity":
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send the body without Content-Encoding.")


def media_type(request: Request) -> str:
    """The Content-Type without its parameters, lower case; "" when there is none."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def chunks(request: Request, limit: int, too_large: str = "UPLOAD_TOO_LARGE") -> AsyncIterator[bytes]:
    """The body as it arrives, at most ``limit`` bytes of it.

    Raises Problem: ``too_large`` by header or by count, UPLOAD_INCOMPLETE when the client leaves or the count is not
    what it declared. How slowly a body may come is for the proxy in front to say.
    """
    declared = declared_length(request)
    if declared is not None and declared > limit:
        raise Problem(too_large, f"At most {limit} bytes are allowed.")
    received = 0
    more = True
    while more:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise Problem("UPLOAD_INCOMPLETE")
        data: bytes = message.get("body", b"")
        received += len(data)
        if received > limit:
            raise Problem(too_large, f"At most {limit} bytes are allowed.")
        if data:
            yield data
        more = message.get("more_body", False)
    if declared is not None and received != declared:
        raise Problem("UPLOAD_INCOMPLETE")


# Reading JSON bodies: large ones beside the event loop, so that other requests go on meanwhile.

_SMALL_BYTES = 16 * 1024
_REASON = "INVALID_REQUEST"
_Model = TypeVar("_Model")


async def read_json(
    request: Request, services: Services, caller: str, model: type[_Model], most_values: int = MOST_VALUES
) -> _Model:
    """The body of a request as ``model``.

    A large one counts among its caller's uploads until it is read: what a caller has in memory is bounded by their
    number. Raises Problem as ``read_model`` and ``body.chunks``, REQUEST_TOO_LARGE, TOO_MANY_REQUESTS_AT_ONCE.
    """
    refuse_encoding(request)
    text = bytearray()
    with ExitStack() as place:
        async for data in chunks(request, services.settings.max_request_bytes, "REQUEST_TOO_LARGE"):
            if len(text) <= _SMALL_BYTES < len(text) + len(data):
                place.enter_context(services.uploads.held(fair_key(request.scope, caller)))
            text += data
        return await read_text(model, bytes(text), most_values)


async def read_text(model: type[_Model], text: bytes, most_values: int = MOST_VALUES, what: str = "The body") -> _Model:
    """As ``read_model``. Raises Problem as that does."""
    if len(text) <= _SMALL_BYTES:
        return read_model(model, text, _REASON, most_values, what)
    return await PARSING.run(read_model, model, text, _REASON, most_values, what)


# Holding an answer back until there is news, without holding a thread.

_FIRST_PAUSE_S = 0.02
_MAX_PAUSE_S = 0.25
_SLOWER = 1.1
"""Each pause is longer than the one before by this factor: an answer comes within a tenth of the time it took."""
_Value = TypeVar("_Value")


async def wait_for(
    fetch: Callable[[], _Value], enough: Callable[[_Value], bool], seconds: float, services: Services, caller: str
) -> _Value:
    """What ``fetch`` (blocking) returns once it is ``enough``, ``seconds`` have passed or the service stops.

    At once where very many wait already, or many of this caller.
    """
    deadline = time.monotonic() + (seconds if services.waiters.has_room(caller) else 0.0)
    step = _FIRST_PAUSE_S
    with services.waiters.held(caller):
        value = await in_thread(fetch)
        while True:
            left = deadline - time.monotonic()
            if enough(value) or left <= 0:
                return value
            if await pause(min(services.waiters.pause_s(caller, step), left), services.stopping):
                return value
            value = await LOOKS.run(fetch)
            step = min(step * _SLOWER, _MAX_PAUSE_S)


# multipart/form-data read as a stream: text parts into memory, file parts straight to where they go.
#
# The framework's own form parser spools files to a temporary folder first; a scene of gigabytes must not pass through
# it.

_MAX_HEADER_BYTES = 4096
_MAX_PARAMETERS = 64
"""Of a header. The library that reads them takes time that grows with the square of their number."""
_MAX_HEADERS = 8


class Sink(Protocol):
    """Where a file part's bytes go."""

    def begin(self, filename: str) -> None:
        """The part has come, under this name; "" for none."""
        ...

    async def feed(self, data: bytes | bytearray) -> None: ...


class _Part:
    def __init__(self) -> None:
        self.headers: dict[str, str] = {}
        self.name = ""
        self.filename = ""
        self.text = bytearray()


class _Collector:
    """Turns the parser's callbacks into a list of (part, bytes): None for a part's beginning."""

    def __init__(self, boundary: str) -> None:
        self.events: list[tuple[_Part, bytearray | None]] = []
        self.ended = False
        self._part = _Part()
        self._field = bytearray()
        self._value = bytearray()
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin,
                "on_part_data": self._data,
                "on_header_field": lambda data, start, end: self._field.extend(data[start:end]),
                "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
                "on_header_end": self._header,
                "on_headers_finished": lambda: self.events.append((self._part, None)),
                "on_end": self._end,
            },
            max_header_count=_MAX_HEADERS,
            max_header_size=_MAX_HEADER_BYTES,
        )

    def _begin(self) -> None:
        self._part = _Part()

    def _data(self, data: bytes, start: int, end: int) -> None:
        """Joined with what came just before: nearly a boundary in every line would make an event of every few bytes."""
        if self.events and isinstance(known := self.events[-1][1], bytearray):
            known += data[start:end]
        else:
            self.events.append((self._part, bytearray(data[start:end])))

    def _end(self) -> None:
        self.ended = True

    def _header(self) -> None:
        name = self._field.decode("latin-1").lower()
        self._part.headers[name] = self._value.decode("latin-1")
        self._field.clear()
        self._value.clear()
        if name == "content-disposition":
            self._part.name = _parameter(self._part.headers[name], "name") or ""
            self._part.filename = _parameter(self._part.headers[name], "filename") or ""

    def feed(self, data: bytes) -> list[tuple[_Part, bytearray | None]]:
        self._parser.write(data)
        events, self.events = self.events, []
        return events


def _parameter(header: str, name: str) -> str | None:
    """One parameter of a structured header such as Content-Disposition or Content-Type; None where there are many."""
    if header.count(";") > _MAX_PARAMETERS:
        return None
    message = email.message.Message()
    message["content-type"] = header.replace("\r", " ").replace("\n", " ")
    try:
        value = message.get_param(name)
    except ValueError:  # a continuation (RFC 2231) numbered with more digits than an integer may have
        return None
    return value if isinstance(value, str) else None


def boundary_of(request: Request) -> str:
    """The boundary that the Content-Type announces. Raises Problem MALFORMED_MULTIPART."""
    boundary = _parameter(request.headers.get("content-type", ""), "boundary")
    if not boundary or not boundary.isascii() or len(boundary) > 70:
        raise Problem("MALFORMED_MULTIPART", "The Content-Type has no valid boundary.")
    return boundary


async def read_parts(
    body: AsyncIterator[bytes],
    boundary: str,
    files: Mapping[str, Sink],
    texts: Mapping[str, int],
) -> dict[str, bytes]:
    """Feed the parts named in ``files`` to their sinks; return the text parts, capped as ``texts`` says, by name.

    A file part that came appears in the answer too, empty. Looking for boundaries takes long where there is nearly one
    in every line, so it is done in a thread, a piece at a time.

    Raises Problem: MALFORMED_MULTIPART, REQUEST_TOO_LARGE, and what the sinks raise.
    """
    collector = _Collector(boundary)
    parts: dict[str, _Part] = {}
    async for data in body:
        try:
            events = await PARSING.run(collector.feed, data)
        except FormParserError as error:
            raise Problem("MALFORMED_MULTIPART") from error
        for part, content in events:
            if content is None:
                _admit(part, parts, files, texts)
            elif part.name in files:
                await files[part.name].feed(content)
            else:
                _add_text(part, content, texts[part.name])
    if not collector.ended:
        raise Problem("MALFORMED_MULTIPART", "The body ends before its closing boundary.")
    return {name: bytes(part.text) for name, part in parts.items()}


def _admit(part: _Part, parts: dict[str, _Part], files: Mapping[str, Sink], texts: Mapping[str, int]) -> None:
    if part.name not in files and part.name not in texts:
        raise Problem("MALFORMED_MULTIPART", f"Known parts: {', '.join([*files, *texts])}.")
    if part.name in parts:
        raise Problem("MALFORMED_MULTIPART", "Two parts have the same name.")
    if part.headers.get("content-transfer-encoding", "binary").lower() not in ("binary", "8bit", "7bit"):
        raise Problem("MALFORMED_MULTIPART", "Content-Transfer-Encoding is not supported.")
    parts[part.name] = part
    if part.name in files:
        files[part.name].begin(part.filename)


def _add_text(part: _Part, content: bytearray, limit: int) -> None:
    if len(part.text) + len(content) > limit:
        raise Problem("REQUEST_TOO_LARGE", f"The part {part.name} can have at most {limit} bytes.")
    part.text += content
