"""``regnf inspect``: what a file holds, and whether it looks like a signed distance field."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.guard import require
from regnf_cli.options import Config, Description, Field, NoConfig, choice_of, source_of
from regnf_cli.report import out, say, tell
from regnf_core.errors import FieldFormatError, InvalidInputError, InvalidOptionsError, filled_folder
from regnf_core.library_entries import shown_number


def inspect(
    field: Field,
    description: Description = None,
    config: Config = None,
    no_config: NoConfig = False,
    picture: Annotated[
        Path | None, typer.Option(help="A PNG to write: two views and a section.", dir_okay=False)
    ] = None,
    candidates: Annotated[
        Path | None,
        typer.Option(
            help="Where to write pictures of what the file may be, if nothing in it tells.",
            file_okay=False,
            metavar="FOLDER",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Say what a field file is: its format and how it was recognized, bounds, parameters, plausibility.

    Example: **regnf inspect step-000030000.ckpt --picture chair.png**

    A file that may be one of several functions is refused with what to say for each; `--candidates` draws them.
    """
    require("engine")
    if picture is not None and (picture.suffix.lower() != ".png" or not picture.parent.is_dir()):
        message = f"--picture {picture}: expected a name that ends in .png, in a folder that exists"
        raise InvalidOptionsError(message, hint="Write for example --picture field.png.")
    if candidates is not None and not candidates.parent.is_dir():
        message = f"--candidates {candidates}: {candidates.parent} is no folder that exists"
        raise InvalidOptionsError(message, hint=f"Make it: mkdir -p {candidates.parent}")
    from regnf_core.importing.gate.gate import import_field
    from regnf_core.importing.gate.picture import PICTURE_NAME

    source = source_of(field, description, choice_of(config, no_config))
    drawn = picture is not None or candidates is not None
    with tempfile.TemporaryDirectory() as folder:
        with _asked(candidates), source.naming(), source.packed_settings() as settings:
            report = import_field(source.file, Path(folder), description, None, drawn, settings).to_dict()
        if picture is not None:
            made = Path(folder) / PICTURE_NAME
            if not made.exists():
                raise InvalidInputError("no picture could be made: the field is too slow for it", reason="NO_PICTURE")
            shutil.copyfile(made, picture)
    if as_json:
        out.print_json(json.dumps(report))
    else:
        _show(report)


@contextmanager
def _asked(folder: Path | None) -> Iterator[None]:
    """Pictures of what a refused file may be are kept in the folder, 1.png and so on as they are numbered."""
    try:
        yield
    except FieldFormatError as error:
        if folder is not None and error.candidates:
            with filled_folder(folder) as work:
                for number, one in enumerate(error.candidates, 1):
                    if one.picture is not None:
                        (work / f"{number}.png").write_bytes(one.picture)
                        tell(f"wrote {folder / f'{number}.png'}")
        raise


def _show(values: dict[str, Any], indent: int = 0) -> None:
    for name, value in values.items():
        if isinstance(value, dict):
            out.print(f"{'  ' * indent}{name}:")
            _show(value, indent + 1)
        else:
            say(f"{'  ' * indent}{name:<24} {_readable(value)}")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return shown_number(value)
    if isinstance(value, list | tuple):
        parts = [_readable(part) for part in value]
        return f"[{', '.join(parts)}]" if any(isinstance(part, float) for part in value) else "; ".join(parts) or "none"
    return "-" if value is None else str(value)
