"""Arguments that a command cannot use: what is wrong, and where the right ones are listed."""

from __future__ import annotations

import re
from difflib import get_close_matches
from typing import Any

from regnf_cli.console import EXIT_BAD_INPUT, err, fail

_CHOICES = re.compile(r"'([^']*)' is not one of (.*?)\.?$")


def usage_fault(error: Any) -> int:
    """Tell of a usage error of typer; the exit code."""
    message = " ".join(error.format_message().replace("Value error, ", "").split())
    context = getattr(error, "ctx", None)
    if context is not None and "NoArgs" in type(error).__name__:
        err.print(context.get_help(), markup=False)
        return EXIT_BAD_INPUT
    command = "regnf" if context is None else " ".join(["regnf", *context.command_path.split()[1:]])
    command = command.replace("regnf -m regnf_cli.main", "regnf")
    hint = f"`{command} --help` shows what it takes."
    if meant := _meant(message):
        hint = f"Did you mean {meant}? {hint}"
    return fail("USAGE", message, EXIT_BAD_INPUT, hint)


def _meant(message: str) -> str | None:
    found = _CHOICES.search(message)
    if found is None:
        return None
    choices = re.findall(r"'([^']*)'", found.group(2))
    near = get_close_matches(found.group(1), choices, n=1)
    return near[0] if near else None
