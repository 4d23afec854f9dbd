"""Making the mesh and the picture of a field that is ready, in a process of its own. Nothing waits for it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from regnf_core.errors import RegnfError
from regnf_core.field_views import FieldViews
from regnf_state.field_views import delete_views, view_key
from regnf_state.records import FieldRecord, StaleAttemptError, ViewState
from regnf_worker.context import Context

_MOST_DRAWINGS = 3
"""A field whose drawing has died with its process as often has nothing to look at."""
logger = logging.getLogger(__name__)


def draw_field(context: Context, reference: str, draw: Callable[[Path], FieldViews]) -> None:
    """Make what people look at of a field, and note in its record that it is there, or cannot be made.

    The record says first that it was begun: a drawing that kills its process is not begun for ever. Does nothing to a
    field that has moved on, and leaves nothing of one that was deleted meanwhile. Raises RedisError, OSError.
    """
    field = context.records.get_field(reference)
    if field is None or field.state != "ready" or field.views != "pending":
        return
    if field.drawings >= _MOST_DRAWINGS:
        logger.warning("field %s is not drawn: it was begun %d times", reference, field.drawings)
        _note(context, field, views="none")
        return
    if not _note(context, field, drawings=field.drawings + 1):
        return
    try:
        with context.blobs.local_copy(view_key(reference, "field.safetensors")) as path:
            made = draw(path)
    except RegnfError as error:
        logger.warning("field %s is not drawn: %s", reference, error)
        _note(context, field, views="none")
        return
    _keep(context, field, made)


def _keep(context: Context, field: FieldRecord, made: FieldViews) -> None:
    kept = made.files()
    delete_views(context.blobs, field.sha256)  # those of what the field was before
    for name, data in kept.items():
        context.blobs.put(view_key(field.sha256, name), data)
    if _note(context, field, views="ready" if kept else "none"):
        return
    now = context.records.get_field(field.sha256)
    if now is None:
        context.blobs.delete_prefix(f"fields/{field.sha256}")
    elif now.views != "ready":
        delete_views(context.blobs, field.sha256)


def _note(context: Context, field: FieldRecord, views: ViewState = "pending", drawings: int | None = None) -> bool:
    """Write it down; False when the field was deleted, or is imported anew."""
    with suppress(StaleAttemptError):
        changes = {} if drawings is None else {"drawings": drawings}
        context.records.update_field(field.sha256, attempt=field.attempt, views=views, **changes)
        return True
    return False
