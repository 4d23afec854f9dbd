"""What a user means by a field: a file, a training run's folder or an archive, with what is said about it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from regnf_core.errors import FieldFormatError, Said
from regnf_core.field_files import require_field_file, require_file
from regnf_core.importing.containers.sniff import HEAD_BYTES, MESH_FORMATS, RUN_ARCHIVES, sniff_format
from regnf_core.importing.run.folder import Run, find_run, pack_settings, settings_beside
from regnf_core.importing.run.opened import DATA_FILES
from regnf_core.library_entries import MOST_OF_LABEL, UNSHOWN

Role = Literal["scene", "object"]
SettingsChoice = str | Path | bool | None
"""A file of settings or an archive of them; None or True: those that lie beside the checkpoint; False: none.

A file of the dataset (meta_data.json, dataparser_transforms.json ...) joins those that lie beside the checkpoint.
"""
_WITHOUT_SETTINGS = frozenset({*MESH_FORMATS, *RUN_ARCHIVES, "safetensors"})
"""Formats that no trainer's settings say anything about, and archives, which have their own."""
_FOUND_BESIDE = "They were found next to the checkpoint. --no-config (in Python config=False) ignores them."
_WITHOUT_ROLE = frozenset({"torch-zip", "torch-legacy", "safetensors", "npz", "sqlite", "onnx"})
"""Formats whose files say which side of the surface is free; of the others the use decides."""


@dataclass(frozen=True)
class FieldSource:
    """named: the path as the user gave it · file: what the importer reads · run: the settings found beside it · config:
    the file of settings that the user named · said: what the user says of it, see UploadDescription · role: what it
    will be used as, where that decides something and the user has not said it · use: the same, whatever it decides."""

    named: Path
    file: Path
    run: Run | None = None
    config: Path | None = None
    said: Mapping[str, Any] = field(default_factory=dict)
    role: Role | None = None
    use: Role | None = None

    @property
    def description(self) -> dict[str, Any]:
        """The input of the importer."""
        return dict(self.said) if self.role is None else {**self.said, "as": self.role}

    @property
    def label(self) -> str:
        """What people call it: as they said, or the name of the file or the folder that they gave."""
        name = os.path.basename(os.path.abspath(self.named))
        return str(self.said.get("label") or re.sub(f"[{UNSHOWN}\\ud800-\\udfff]", "", name)[:MOST_OF_LABEL])

    @property
    def description_to_send(self) -> dict[str, Any]:
        """The input of a service: the same, and a name."""
        return {**self.description, **({"label": self.label} if self.label else {})}

    @property
    def settings(self) -> tuple[Path, ...]:
        """The files of settings that go with the field."""
        if self.config is not None:
            return (self.config,)
        return () if self.run is None else self.run.settings

    @property
    def settings_names(self) -> list[str]:
        """The same as a person finds them again: by their places in the run's folder."""
        if self.config is not None:
            return [str(self.config)]
        if self.run is None:
            return []
        folder = os.path.commonpath([path.parent for path in (self.run.checkpoint, *self.run.settings)])
        return [str(path.relative_to(folder)) for path in self.run.settings]

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Errors about the content begin with the file's name; about settings, they say how these came in."""
        try:
            with naming(self.file):
                yield
        except FieldFormatError as error:
            error.said = Said(self.use, self.said)
            if self.run is None or not error.reason.startswith("SETTINGS_"):
                raise
            hint = " ".join(filter(None, [error.hint, _FOUND_BESIDE]))
            raise error.told(str(error), hint) from error

    @contextmanager
    def packed_settings(self) -> Iterator[Path | None]:
        """All settings in one file, which stays for as long as the context; None where there are none."""
        if self.config is not None or self.run is None or not self.run.settings:
            yield self.config
            return
        with TemporaryDirectory(prefix="settings-") as folder:
            yield pack_settings(self.run, Path(folder))


def find_source(
    path: Path, description: Mapping[str, Any] | None = None, config: SettingsChoice = None, role: Role | None = None
) -> FieldSource:
    """What a path stands for. role: what the field will be used as.

    Raises InvalidInputError (FILE_NOT_FOUND) and FieldFormatError naming the path: what ``find_run`` does of a folder.
    """
    if not isinstance(description, Mapping | None):
        message = f"the description is a {type(description).__name__}, expected a dictionary"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION", hint='Write for example {"up_axis": "z"}.')
    run, file = None, path
    if path.is_dir():
        with naming(path):
            run = find_run(path)
        file = run.checkpoint
    require_field_file(file)
    format_ = format_of(file)
    if run is None and format_ not in _WITHOUT_SETTINGS and config is not False:
        with naming(path):
            run = Run(file.resolve(), settings_beside(file))
    run, named = _settings_of(run, config)
    said = dict(description or {})
    return FieldSource(path, file, run, named, said, assumed_role(said, format_, role).get("as"), role)


def _settings_of(run: Run | None, chosen: SettingsChoice) -> tuple[Run | None, Path | None]:
    """What is read of the settings found beside, and the file that is read in place of them."""
    if chosen is False:
        return None, None
    if not isinstance(chosen, str | Path):
        return run, None
    named = Path(chosen)
    require_file(named)
    if run is not None and run.settings and named.name in DATA_FILES:
        return run.joined_by(named), None
    return None, named


def assumed_role(said: Mapping[str, Any], format_: str | None, role: Role | None) -> dict[str, Role]:
    """The entry that a field's use adds to its description, where that decides something and it was not said."""
    return {} if role is None or "as" in said or format_ in _WITHOUT_ROLE else {"as": role}


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors about the file's content begin with its name."""
    try:
        yield
    except FieldFormatError as error:
        if str(error).startswith(str(path)):
            raise
        raise error.told(f"{path}: {error}") from error


def format_of(file: Path) -> str | None:
    """What a file seems to be, from its first bytes."""
    with file.open("rb") as opened:
        return sniff_format(opened.read(HEAD_BYTES))
