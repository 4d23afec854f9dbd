"""``regnf doctor``: what is wrong with an installation, and how to mend it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column, Table

from regnf_cli.checks.libraries import Finding, check_gpu, check_libraries, check_native
from regnf_cli.guard import require
from regnf_cli.report import EXIT_UNAVAILABLE, out
from regnf_core.errors import InvalidInputError, MissingExtraError

_COLORS = {"ok": "green", "warning": "yellow", "error": "bold red"}


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Look at libraries, GPU, Redis, storage, disk, memory, open files and the port, and say how to mend what is wrong.

    The service's settings are read from REGNF_* in the environment.

    Example: **regnf doctor**

    Exit codes: 0 nothing is wrong (there may be warnings), 3 something is.
    """
    findings = list(check_all())
    if as_json:
        out.print_json(json.dumps([asdict(one) for one in findings]))
    else:
        _show(findings)
    raise typer.Exit(EXIT_UNAVAILABLE if any(one.state == "error" for one in findings) else 0)


def check_all() -> Iterator[Finding]:
    """Everything, in the order in which a user needs it."""
    yield from check_libraries()
    yield from check_native()
    yield check_gpu()
    try:
        require("service")
    except MissingExtraError as error:
        yield Finding("service", "warning", str(error), "Needed to serve, not to register here or to use a service.")
        return
    from regnf_cli.checks.service import check_service
    from regnf_state.settings import read_settings

    try:
        settings = read_settings()
    except InvalidInputError as error:
        yield Finding("settings", "error", str(error), error.hint)
        return
    yield from check_service(settings)


def _show(findings: list[Finding]) -> None:
    table = Table("", "", Column(overflow="fold"), box=None, show_header=False)
    for one in findings:
        table.add_row(f"[{_COLORS[one.state]}]{one.state}[/]", one.subject, escape(one.found))
    out.print(table)
    for one in findings:
        if one.hint is not None:
            out.print(f"{one.subject}: {one.hint}", markup=False, soft_wrap=True)
