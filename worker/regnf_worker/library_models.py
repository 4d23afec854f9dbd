"""Models of the objects of libraries, made once the object is an entry: no search has to make them first."""

from __future__ import annotations

import logging
from pathlib import Path
from tempfile import TemporaryDirectory

from regnf_core.errors import RegnfError
from regnf_core.options import RegistrationOptions
from regnf_state.record_store import RecordStore
from regnf_worker.context import Context
from regnf_worker.engine import Engine
from regnf_worker.models import ObjectModels

logger = logging.getLogger(__name__)


def is_unmodeled_entry(records: RecordStore, reference: str, attempt: int) -> bool:
    """Whether the field is ready, an entry of its owner's library, and its symmetry is not known."""
    field = records.get_field(reference)
    return (
        field is not None
        and field.attempt == attempt
        and field.state == "ready"
        and field.library is not None
        and field.symmetry is None
    )


def model_entry(context: Context, reference: str, engine: Engine) -> None:
    """Make the model of an entry's field, keep it, and note the symmetry. What is no object is left as it is."""
    field = context.records.get_field(reference)
    if field is None:
        return
    with (
        TemporaryDirectory(prefix="model-") as folder,
        context.blobs.local_copy(f"fields/{reference}/field.safetensors") as safe_field,
    ):
        try:
            ObjectModels(context, engine, RegistrationOptions(), Path(folder)).of(field, lambda: safe_field)
        except RegnfError as error:
            logger.info("field %s has no model as an object: %s", reference, error)
