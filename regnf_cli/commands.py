"""The sub-commands of ``regnf``. One that is asked for is loaded alone: others bring HTTP and fitting along."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Annotated

import typer

from regnf_core import __version__

COMMANDS = (
    "demo", "register", "search", "batch", "serve", "worker", "inspect", "convert", "fit", "fuse", "render", "edit",
    "doctor", "render-dataset", "manual",
)  # fmt: skip
"""In the order of the help. Each is a function in a module, both of its name, with underscores."""
GROUPS = ("library",)
"""Each is the ``app`` of the module of its name, with sub-commands of its own."""


def app_of(names: Iterable[str] = (*COMMANDS, *GROUPS)) -> typer.Typer:
    """The command with these sub-commands."""
    app = typer.Typer(
        name="regnf",
        help="Register neural signed distance fields: find where a known object stands in a scanned room.",
        epilog="Exit codes: 0 registered or done, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.",
        no_args_is_help=True,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(root)
    for name in names:
        function = name.replace("-", "_")
        module = import_module(f"regnf_cli.{function}")
        if name in GROUPS:
            app.add_typer(module.app, name=name)
        else:
            app.command(name)(getattr(module, function))
    return app


def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
