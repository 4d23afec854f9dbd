"""Fields named at the command line: the options that go with them, and what they stand for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from regnf_cli.console import err
from regnf_cli.paths import file
from regnf_cli.request_files import is_json, read_object
from regnf_core.errors import FieldFormatError
from regnf_core.field_source import FieldSource, Role, SettingsChoice, find_source
from regnf_core.texts import json_value


def description(text: str) -> dict[str, Any]:
    """A description: JSON written out, or the name of a file that holds it.

    Raises InvalidInputError (FILE_NOT_FOUND, FILE_IS_FOLDER, MALFORMED_JSON), FieldFormatError (INVALID_DESCRIPTION).
    """
    from regnf_core.importing.upload_description import UploadDescription

    values = json_value(text, "description: ") if is_json(text) else read_object(file(text), "description")
    try:
        UploadDescription.from_dict(values)
    except FieldFormatError as error:
        hint = "docs/import-gate.md lists every entry of a description."
        raise FieldFormatError(str(error), reason=error.reason, hint=error.hint or hint) from error
    return values


def choice_of(config: Path | None, no_config: bool) -> SettingsChoice:
    """Which settings are meant by --config and --no-config."""
    return config if config is not None else not no_config


def source_of(
    path: Path, said: Mapping[str, Any] | None, settings: SettingsChoice = None, role: Role | None = None
) -> FieldSource:
    """What a path stands for; the settings that were found are said. Raises what ``find_source`` does."""
    source = find_source(path, said, settings, role)
    if source.file != path:
        err.print(f"checkpoint: {source.file}", markup=False, soft_wrap=True)
    if source.settings:
        err.print(f"settings: {', '.join(source.settings_names)}", markup=False, soft_wrap=True)
    return source


CONFIG: dict[str, Any] = {"parser": file, "metavar": "FILE"}
DESCRIPTION: dict[str, Any] = {"parser": description, "metavar": "JSON"}
"""How options of these kinds are declared. A description is a file, or the JSON itself."""
