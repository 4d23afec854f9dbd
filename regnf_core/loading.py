"""Open whatever file a user has as a field: a safe field, or anything that the import gate takes."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core import __version__
from regnf_core.errors import FieldFormatError
from regnf_core.field_files import require_field_file

if TYPE_CHECKING:
    from regnf_core.fields.base import SdfField

_READ_BYTES = 1 << 20


def load_field(
    path: str | Path, description: dict[str, Any] | None = None, device: str = "cpu", cache_dir: Path | None = None
) -> SdfField:
    """The field in a file, on ``device``.

    A safe field is opened as it is. Anything else goes through the import gate, whose outcome is kept in ``cache_dir``
    under the file's SHA-256. ``description`` says what the file does not carry, see UploadDescription.

    Raises FieldFormatError (with the gate's reason) and InvalidInputError (FILE_NOT_FOUND, FILE_IS_FOLDER), which name
    the file and, for the folder of a training run, the checkpoint that was meant.
    """
    from regnf_core.fields.build import open_field

    safe = safe_field_path(Path(path), description, cache_dir)
    with naming(Path(path)):
        return open_field(safe, device)


def safe_field_path(path: Path, description: dict[str, Any] | None = None, cache_dir: Path | None = None) -> Path:
    """The safe field for a file: the file itself when it is one already, else what the import gate made of it.

    Raises FieldFormatError and InvalidInputError naming the file.
    """
    require_field_file(path)
    with naming(path):
        return _safe_field_path(path, description, cache_dir)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors about the file's content begin with its name."""
    try:
        yield
    except FieldFormatError as error:
        if str(error).startswith(str(path)):
            raise
        raise FieldFormatError(f"{path}: {error}", reason=error.reason, hint=error.hint) from error


def _safe_field_path(path: Path, description: dict[str, Any] | None, cache_dir: Path | None) -> Path:
    from regnf_core.schema.safe_format import read_description

    if path.suffix.lower() == ".safetensors":
        try:
            read_description(path)
        except FieldFormatError:
            if description is None:
                raise
        else:
            if not description:
                return path
    return _imported(path, description, cache_dir or default_cache_dir())


def default_cache_dir() -> Path:
    """Where imported checkpoints are kept between runs: under XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "regnf" / "fields"


def _imported(path: Path, description: dict[str, Any] | None, cache_dir: Path) -> Path:
    from regnf_core.importing.gate.gate import ImportLimits, import_field

    key = hashlib.sha256(repr((__version__, sorted((description or {}).items()))).encode())
    with path.open("rb") as file:
        while block := file.read(_READ_BYTES):
            key.update(block)
    kept = cache_dir / f"{key.hexdigest()}.safetensors"
    if kept.exists():
        return kept
    cache_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=cache_dir) as folder:
        import_field(path, Path(folder), description, ImportLimits())
        os.replace(Path(folder) / "field.safetensors", kept)
    return kept
