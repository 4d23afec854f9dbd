"""What the commands share for talking to people and to programs."""

from __future__ import annotations

import re

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from regnf_core.hints import hint_of

EXIT_REGISTERED = 0
EXIT_NOT_REGISTERED = 1
EXIT_BAD_INPUT = 2
EXIT_UNAVAILABLE = 3
EXIT_AMBIGUOUS = 4

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)
_PAGE = re.compile(r"\bdocs/([a-z0-9/-]+)\.md\b")


def fail(reason: str, message: str, code: int = EXIT_BAD_INPUT, hint: str | None = None) -> int:
    """Say on stderr what went wrong, and what to do next; returns the exit code."""
    err.print(f"[bold red]{reason}[/] ", end="")
    err.print(_with_commands(message), markup=False, soft_wrap=True)
    if hint := hint or hint_of(reason):
        err.print("[bold]hint:[/] ", end="")
        err.print(_with_commands(hint), markup=False, soft_wrap=True)
    return code


def _with_commands(text: str) -> str:
    """Pages of the manual by the command that prints them: an installed regnf has no folder docs."""
    return _PAGE.sub(r"`regnf manual \1`", text)


def phase_progress() -> Progress:
    """A bar on stderr, so that stdout stays clean for results."""
    return Progress(
        TextColumn("{task.description:>14}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), console=err
    )
