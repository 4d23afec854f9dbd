"""What the commands share for talking to people and to programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from regnf_core.errors import InvalidInputError

EXIT_REGISTERED = 0
EXIT_NOT_REGISTERED = 1
EXIT_BAD_INPUT = 2
EXIT_UNAVAILABLE = 3

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def fail(reason: str, message: str, code: int = EXIT_BAD_INPUT) -> int:
    """Say on stderr what went wrong; returns the exit code."""
    err.print(f"[bold red]{reason}[/] ", end="")
    err.print(message, markup=False, soft_wrap=True)
    return code


def phase_progress() -> Progress:
    """A bar on stderr, so that stdout stays clean for results."""
    return Progress(
        TextColumn("{task.description:>14}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), console=err
    )


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A JSON object from a file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{what} {path}: {error}", reason="MALFORMED_JSON") from error
    if not isinstance(value, dict):
        raise InvalidInputError(f"{what} {path}: expected a JSON object", reason="MALFORMED_JSON")
    return value


def show_result(document: dict[str, Any]) -> None:
    """A result document for people: verdict, the 4x4, the figures that matter."""
    colour = {"registered": "green", "ambiguous": "yellow"}.get(document["verdict"], "red")
    out.print(f"verdict      [bold {colour}]{document['verdict']}[/]  ({document['verdict_reason']})")
    transform = document["T_object_scene"]
    out.print("T_object_scene (scene coordinates to object coordinates)")
    for row in transform["matrix"]:
        out.print("   " + " ".join(f"{value: .6f}" for value in row))
    out.print(f"scale        {transform['scale']:.6f}")
    for name, value in document["metrics"].items():
        out.print(f"{name:<28} {value:.6g}" if isinstance(value, float) else f"{name:<28} {value}")


def exit_code(document: dict[str, Any]) -> int:
    """0 for a registered result, 1 for anything else."""
    return EXIT_REGISTERED if document["verdict"] == "registered" else EXIT_NOT_REGISTERED
