"""The model of an object, made by the first registration that uses it, or for a library, and kept beside its field."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

from redis.exceptions import RedisError

from regnf_core.errors import RegnfError
from regnf_core.options import RegistrationOptions
from regnf_core.version import ENGINE_REVISION
from regnf_state.blobs.base import BlobStore
from regnf_state.records import FieldRecord, StaleAttemptError
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.room import Originals
from regnf_state.settings import Settings
from regnf_state.stores import open_stores
from regnf_worker.engine import Engine, Model

# What a job is given: settings and stores, made from the environment in the job's own process.

_RETRIES = 20
"""About eighteen seconds: a job outlives a restart of Redis."""
_STORAGE_WAIT_S = 120.0


@dataclass(frozen=True)
class Context:
    """Settings and stores of one process."""

    settings: Settings
    records: RecordStore
    blobs: BlobStore
    queue: JobQueue

    @cached_property
    def originals(self) -> Originals:
        """The uploads that stay after their import."""
        return Originals(self.records, self.blobs, self.settings)

    @classmethod
    def from_settings(cls, settings: Settings, existing: bool = False) -> Context:
        """The stores that the settings name; ``existing`` as ``open_stores`` has it. Raises NoRedisError."""
        stores = open_stores(settings, retries=_RETRIES, storage_wait_s=_STORAGE_WAIT_S, existing=existing)
        return cls(settings, stores.records, stores.blobs, stores.queue)


logger = logging.getLogger(__name__)


def model_key(sha256: str) -> str:
    """Where an object's model lies: another revision of the engine does not find it, and makes its own."""
    return f"fields/{sha256}/object-model-{ENGINE_REVISION}.safetensors"


class ObjectModels:
    """Models for one request's options. A kept file that does not read is made again; nothing else is believed of it.

    Only models by the default options are kept: others are made for the job alone, in ``folder``.
    """

    def __init__(self, context: Context, engine: Engine, options: RegistrationOptions, folder: Path) -> None:
        self._context = context
        self._engine = engine
        self._options = options
        self._folder = folder
        # the number of its samples is all that options have a say in of the model that is kept
        self._kept = options.robust.object_samples == RegistrationOptions().robust.object_samples

    def of(self, field: FieldRecord, open_field: Callable[[], Path]) -> Model:
        """The model of a field; ``open_field`` is called if it must be made. Raises RegnfError when it cannot be."""
        model = self._read(field) if self._kept else None
        if model is None:
            model = self._make(field, open_field())
        if self._kept and field.symmetry is None:
            self._store_symmetry(field, model)
        return model

    def _read(self, field: FieldRecord) -> Model | None:
        with suppress(FileNotFoundError), self._context.blobs.local_copy(model_key(field.sha256)) as path:
            try:
                return self._engine.read_model(path)
            except RegnfError as error:
                logger.warning("the model of %s is computed again: %s", field.sha256, error)
                self._context.blobs.delete(model_key(field.sha256))
        return None

    def _make(self, field: FieldRecord, path: Path) -> Model:
        """Written and read back: the first job must find what all others will."""
        made = self._folder / f"model-{field.sha256}.safetensors"
        self._engine.make_model(path, self._options, made)
        model = self._engine.read_model(made)
        if self._kept:
            self._keep(field, made.read_bytes())
        made.unlink()
        return model

    def _keep(self, field: FieldRecord, data: bytes) -> None:
        now = self._context.records.get_field(field.sha256)
        if now is None or now.attempt != field.attempt:
            return  # deleted during the job, and perhaps uploaded with another description
        self._context.blobs.put_if_absent(model_key(field.sha256), data)

    def _store_symmetry(self, field: FieldRecord, model: Model) -> None:
        symmetry = self._engine.symmetry(model)
        try:
            self._context.records.update_field(field.sha256, attempt=field.attempt, symmetry=symmetry)
        except StaleAttemptError:
            logger.info("field %s was deleted: its symmetry is not stored", field.sha256)
        except RedisError as error:
            logger.warning("the symmetry of %s is not stored: %s", field.sha256, error)


# Models of the objects of libraries, made once the object is an entry: no search has to make them first.


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
