"""Reading large JSON bodies beside the event loop, so that other requests go on meanwhile."""

from __future__ import annotations

from typing import TypeVar

from regnf_service.concurrency import PARSING
from regnf_service.http.json_size import MOST_VALUES
from regnf_service.http.schemas.reading import read_model

_SMALL_BYTES = 16 * 1024
_Model = TypeVar("_Model")


async def read_body(
    model: type[_Model],
    text: bytes,
    otherwise: str = "INVALID_REQUEST",
    most_values: int = MOST_VALUES,
) -> _Model:
    """As ``read_model``. Raises Problem as that does."""
    if len(text) <= _SMALL_BYTES:
        return read_model(model, text, otherwise, most_values)
    return await PARSING.run(read_model, model, text, otherwise, most_values)
