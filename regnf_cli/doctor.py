"""``regnf doctor``: what is wrong with an installation, and how to mend it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer
from rich.markup import escape
from rich.table import Column, Table

from regnf_cli.checks.libraries import Finding, check_gpu, check_libraries, check_native
from regnf_cli.guard import require
from regnf_cli.report import EXIT_UNAVAILABLE, out
from regnf_core.errors import InvalidInputError, MissingExtraError

if TYPE_CHECKING:
    from regnf_state.settings import Settings


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


# The service's settings as a command reads them: the environment, and what was given on the command line.

_HINT = "Correct the environment variable, or unset it to use the default."
_REDIS_SCHEMES = ("redis", "rediss", "unix")


def read_settings(**given: Any) -> Settings:
    """The settings; what is None is read from REGNF_* in the environment.

    Raises InvalidInputError (INVALID_SETTINGS) naming the first faulty setting, never its value: it may be a token.
    """
    from pydantic import ValidationError
    from pydantic_settings import SettingsError

    from regnf_state.settings import Settings

    try:
        settings = Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = f"REGNF_{where.upper()}: {first['msg'].removeprefix('Value error, ')}"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint=_HINT) from error
    except SettingsError as error:
        raise InvalidInputError(str(error), reason="INVALID_SETTINGS", hint=_HINT) from error
    if settings.redis_url is not None:
        check_redis_url(settings.redis_url, "REGNF_REDIS_URL")
    return settings


def check_redis_url(url: str, name: str) -> None:
    """Raises InvalidInputError (INVALID_SETTINGS) naming the setting, never its value: it may hold a password."""
    if urlsplit(url).scheme not in _REDIS_SCHEMES:
        message = f"{name}: no address of a Redis, expected redis://, rediss:// or unix://"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint="Write for example redis://127.0.0.1:6379/0.")
