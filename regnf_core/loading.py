"""Open whatever a user has as a field: a regnf field file, or anything that the importer takes, with its settings."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import atomic_path
from regnf_core.field_notes import FieldNotes
from regnf_core.field_source import FieldSource, SettingsChoice, find_source
from regnf_core.in_memory import FieldWarning, field_of
from regnf_core.version import ENGINE_REVISION, __version__

if TYPE_CHECKING:
    from regnf_core.fields.observation import SdfField


@dataclass(frozen=True)
class SafeField:
    """A regnf field file, and what its import said."""

    path: Path
    notes: FieldNotes


@dataclass(frozen=True)
class LoadedField:
    """A field ready to be evaluated, and what its import said."""

    field: SdfField
    notes: FieldNotes


def open_field(
    path: str | os.PathLike[str] | object,
    description: Mapping[str, Any] | None = None,
    config: SettingsChoice = None,
    device: str = "cpu",
    cache_dir: Path | None = None,
) -> SdfField:
    """The field in a file, a training run's folder or an archive of one, on ``device``.

    A regnf field file is opened as it is. Anything else goes through the importer, whose outcome is kept in
    ``cache_dir``. In place of a path, a mesh or a cloud of trimesh or Open3D is taken as a file of it would be.
    ``description`` says what the file does not carry, see UploadDescription. ``config`` names the trainer's settings: a
    file, or an archive of several; None takes those beside the checkpoint, False none. A warning of the import is
    issued as a FieldWarning.

    Raises FieldFormatError (with the importer's reason) and InvalidInputError (FILE_NOT_FOUND, FILE_IS_FOLDER), which
    name the file, and InvalidInputError (NO_FIELD) for what is neither a path nor a mesh.
    """
    if not isinstance(path, str | os.PathLike):
        from regnf_core.fields.build import usable_device

        return field_of(path, description=description).to(usable_device(device))
    loaded = load_field(find_source(Path(path), description, config), device, cache_dir)
    for warning in loaded.notes.warnings:
        warnings.warn(f"{path}: {warning}", FieldWarning, stacklevel=2)
    return loaded.field


def load_field(source: FieldSource, device: str = "cpu", cache_dir: Path | None = None) -> LoadedField:
    """The field, and what its import said. Raises as ``open_field`` does."""
    from regnf_core.fields.build import open_field as open_safe_field

    safe = safe_field(source, cache_dir)
    with source.naming():
        return LoadedField(open_safe_field(safe.path, device), safe.notes)


def safe_field(source: FieldSource, cache_dir: Path | None = None) -> SafeField:
    """The regnf field file for a source: the file itself when it is one already, else what the importer made of it.

    Raises FieldFormatError and InvalidInputError naming the file.
    """
    with source.naming():
        if source.file.suffix.lower() == ".safetensors" and not source.description and not source.settings:
            from regnf_core.schema.safe_format import read_description

            return SafeField(source.file, FieldNotes.of_source(read_description(source.file)["source"]))
        return _imported(source, cache_dir or default_cache_dir())


def import_smallest_first(sources: Iterable[FieldSource]) -> None:
    """Import several files, so that one that is refused is not refused only after a large one's import.

    Raises as ``safe_field`` does.
    """
    for source in sorted(sources, key=lambda one: one.file.stat().st_size):
        safe_field(source)


def default_cache_dir() -> Path:
    """Where imported checkpoints are kept between runs: under XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "regnf" / "fields"


def _imported(source: FieldSource, cache_dir: Path) -> SafeField:
    from regnf_core.importing.gate.gate import FIELD_NAME, import_field

    name = _digest(source)
    kept, report = cache_dir / f"{name}.safetensors", cache_dir / f"{name}.json"
    with suppress(OSError, ValueError, AttributeError):  # not there, or damaged: made again
        notes = FieldNotes.of_report(json.loads(report.read_text(encoding="utf-8")))
        if kept.exists():
            return SafeField(kept, notes)
    cache_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_dir) as folder, source.packed_settings() as settings:
        said = source.description or None
        made = import_field(source.file, Path(folder), said, settings=settings)
        notes = FieldNotes.of_report(made.to_dict())
        with atomic_path(report) as path:
            path.write_text(json.dumps(notes.to_dict()), encoding="utf-8")
        os.replace(Path(folder) / FIELD_NAME, kept)
    return SafeField(kept, notes)


def _digest(source: FieldSource) -> str:
    """Of all that the import depends on: the release, what was said, the settings' files and the file itself."""
    said = json.dumps(source.description, sort_keys=True, default=repr)
    digest = hashlib.sha256(f"{__version__} {ENGINE_REVISION} {said}".encode())
    for path in (*source.settings, source.file):
        with path.open("rb") as file:
            digest.update(f" {path.name} ".encode(errors="surrogateescape"))
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
