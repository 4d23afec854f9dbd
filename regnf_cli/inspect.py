"""``regnf inspect``: what a file holds, and whether it looks like a signed distance field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from regnf_cli.console import out
from regnf_cli.extras import require
from regnf_cli.request_files import read_object


def inspect(
    field: Annotated[Path, typer.Argument(help="A safe field or a checkpoint.", exists=True, dir_okay=False)],
    description: Annotated[
        Path | None, typer.Option(help="JSON: what the checkpoint does not carry.", exists=True, dir_okay=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Say what a field file is: family, why, bounds, parameters, plausibility.

    Example: **regnf inspect step-000030000.ckpt**
    """
    require("engine")
    import tempfile

    from regnf_core.importing.gate import ImportLimits, import_field

    given = read_object(description, "description") if description else None
    with tempfile.TemporaryDirectory() as folder:
        report = import_field(field, Path(folder), given, ImportLimits()).to_dict()
    if as_json:
        out.print_json(json.dumps(report))
    else:
        _show(report)


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
