"""Reading large JSON bodies beside the event loop, one at a time, so that other requests go on meanwhile."""

from __future__ import annotations

from typing import TypeVar

from anyio import to_thread

from regnf_service.http.json_size import MOST_VALUES
from regnf_service.http.schemas.reading import read_model
from regnf_service.services import Services

_SMALL_BYTES = 16 * 1024
_Model = TypeVar("_Model")


async def read_body(
    services: Services,
    model: type[_Model],
    text: bytes,
    otherwise: str = "INVALID_REQUEST",
    most_values: int = MOST_VALUES,
) -> _Model:
    """As ``read_model``. Raises Problem as that does."""
    if len(text) <= _SMALL_BYTES:
        return read_model(model, text, otherwise, most_values)
    return await to_thread.run_sync(read_model, model, text, otherwise, most_values, limiter=services.parse_limiter)
