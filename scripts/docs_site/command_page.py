"""The reference of the command line, from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from regnf_cli.commands import app_of

_HEAD = """# Command line

Made from the commands themselves; `regnf COMMAND --help` says the same. How they go together:
[How-to](../how-to/index.md).
Exit codes: 0 registered or done, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable,
70 an error of regnf itself, 128 + N ended by the signal N.
"""


def command_page() -> str:
    group: Any = typer.main.get_command(app_of())
    parts = [_HEAD]
    for name, command in sorted(_named(group)):
        context = command.make_context(name, [], resilient_parsing=True)
        told = [
            f"## regnf {name}",
            command.help or "",
            f"```text\n{_usage(name, command)}\n```",
            _table(command, context),
        ]
        parts += [part for part in told if part]
    return "\n\n".join(parts) + "\n"


def _named(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every command by what is typed for it; those of a group in place of it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _named(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


def _usage(name: str, command: Any) -> str:
    arguments = [_metavar(one) for one in command.params if one.param_type_name == "argument"]
    return " ".join(["regnf", name, *arguments, "[OPTIONS]"])


def _metavar(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper())


def _table(command: Any, context: Any) -> str:
    rows = [_row(one, context) for one in command.params if not getattr(one, "hidden", False)]
    return "\n".join(["| | | default |", "|---|---|---|", *rows]) if rows else ""


def _row(parameter: Any, context: Any) -> str:
    names = (
        [_metavar(parameter)] if parameter.param_type_name == "argument" else parameter.opts + parameter.secondary_opts
    )
    shown = ", ".join(f"`{name}`" for name in names)
    text = " ".join((parameter.help or "").split()).replace("|", "\\|")
    default = parameter.get_default(context)
    blank = default is None or default is False or callable(default)
    return f"| {shown} | {text} | {'required' if parameter.required else '' if blank else f'`{default}`'} |"
