"""Reading JSON bodies: large ones beside the event loop, so that other requests go on meanwhile."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TypeVar

from starlette.requests import Request

from regnf_service.concurrency import PARSING
from regnf_service.http import body
from regnf_service.http.json_size import MOST_VALUES
from regnf_service.http.pace import Pace
from regnf_service.http.schemas.reading import read_model
from regnf_service.http.turns import fair_key
from regnf_service.services import Services

_SMALL_BYTES = 16 * 1024
_REASON = "INVALID_REQUEST"
_Model = TypeVar("_Model")


async def read_json(
    request: Request, services: Services, caller: str, model: type[_Model], most_values: int = MOST_VALUES
) -> _Model:
    """The body of a request as ``model``.

    A large one counts among its caller's uploads until it is read: what a caller has in memory is bounded by their
    number. Raises Problem as ``read_model`` and ``body.chunks``, REQUEST_TOO_LARGE, TOO_MANY_UPLOADS.
    """
    body.refuse_encoding(request)
    pace = Pace(services.settings)
    text = bytearray()
    async with AsyncExitStack() as place:
        async for data in body.chunks(request, services.settings.max_request_bytes, pace, "REQUEST_TOO_LARGE"):
            if len(text) <= _SMALL_BYTES < len(text) + len(data):
                await place.enter_async_context(services.uploads.held(fair_key(request.scope, caller), pace))
            text += data
        return await read_text(model, bytes(text), most_values)


async def read_text(model: type[_Model], text: bytes, most_values: int = MOST_VALUES, what: str = "The body") -> _Model:
    """As ``read_model``. Raises Problem as that does."""
    if len(text) <= _SMALL_BYTES:
        return read_model(model, text, _REASON, most_values, what)
    return await PARSING.run(read_model, model, text, _REASON, most_values, what)
