"""``regnf inspect``: what a file holds, and whether it looks like a signed distance field."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.console import out
from regnf_cli.extras import require
from regnf_cli.field_options import CONFIG, DESCRIPTION, choice_of, source_of
from regnf_cli.paths import FIELD
from regnf_core.errors import InvalidInputError, InvalidOptionsError


def inspect(
    field: Annotated[Path, typer.Argument(help="A file, a training run's folder or an archive of one.", **FIELD)],
    description: Annotated[
        dict[str, Any] | None, typer.Option(help="What the file does not say: a file or JSON.", **DESCRIPTION)
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="The settings that the field was trained with: a file or an archive.", **CONFIG)
    ] = None,
    no_config: Annotated[
        bool, typer.Option("--no-config", help="Leave settings that lie beside the checkpoint unread.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="A PNG to write: two views and a section.", dir_okay=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Say what a field file is: its format and how it was recognized, bounds, parameters, plausibility.

    Example: **regnf inspect step-000030000.ckpt --picture chair.png**
    """
    require("engine")
    import tempfile

    from regnf_core.importing.gate.gate import ImportLimits, import_field
    from regnf_core.importing.gate.picture import PICTURE_NAME

    if picture is not None and (picture.suffix.lower() != ".png" or not picture.parent.is_dir()):
        message = f"--picture {picture}: expected a name that ends in .png, in a folder that exists"
        raise InvalidOptionsError(message, hint="Write for example --picture field.png.")
    source = source_of(field, description, choice_of(config, no_config))
    with tempfile.TemporaryDirectory() as folder:
        with source.naming(), source.packed_settings() as settings:
            made = import_field(source.file, Path(folder), description, ImportLimits(), picture is not None, settings)
            report = made.to_dict()
        if picture is not None:
            _keep(Path(folder) / PICTURE_NAME, picture)
    if as_json:
        out.print_json(json.dumps(report))
    else:
        _show(report)


def _keep(made: Path, picture: Path) -> None:
    if not made.exists():
        raise InvalidInputError("no picture could be made: the field is too slow for it", reason="NO_PICTURE")
    shutil.copyfile(made, picture)


def _show(values: dict[str, Any], indent: int = 0) -> None:
    for name, value in values.items():
        if isinstance(value, dict):
            out.print(f"{'  ' * indent}{name}:")
            _show(value, indent + 1)
        else:
            out.print(f"{'  ' * indent}{name:<24} {_readable(value)}", markup=False, soft_wrap=True)


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        parts = [_readable(part) for part in value]
        return f"[{', '.join(parts)}]" if any(isinstance(part, float) for part in value) else "; ".join(parts) or "none"
    return "-" if value is None else str(value)
