"""The sub-commands of ``regnf``. One that is requested is loaded alone: others bring HTTP and fitting along."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from importlib import import_module
from typing import Annotated, Any

import typer

from regnf_cli.report import EXIT_BAD_INPUT, err, fail
from regnf_core import __version__

COMMANDS = {
    "demo": "demo", "register": "register", "search": "register", "populate": "populate", "compare": "populate",
    "batch": "batch", "serve": "serve", "worker": "serve", "inspect": "inspect", "convert": "convert", "fit": "fit",
    "fuse": "fit", "render": "render", "edit": "render", "doctor": "doctor", "manual": "manual",
}  # fmt: skip
"""In the order of the help, each with its module. Its function has its name."""
GROUPS = ("library",)
"""Each is the ``app`` of the module of its name, with sub-commands of its own."""


def app_of(names: Iterable[str] = (*COMMANDS, *GROUPS)) -> typer.Typer:
    """The command with these sub-commands."""
    app = typer.Typer(
        name="regnf",
        help="Register neural signed distance fields: find the pose of a known object in a scanned room.",
        epilog="Exit codes: 0 registered or done, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.",
        no_args_is_help=True,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(root)
    for name in names:
        module = import_module(f"regnf_cli.{COMMANDS.get(name, name)}")
        if name in GROUPS:
            app.add_typer(module.app, name=name)
        else:
            app.command(name)(getattr(module, name))
    return app


def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


# Arguments that a command cannot use: what is wrong, and where the right ones are listed.

_RENAMED = {"--truth": "--ground-truth", "--jobs": "--processes", "--up": "--up-axis"}
"""Options of earlier versions, and what they are called now."""
_UNKNOWN = re.compile(r"No such option: (--[\w-]+)")
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
    hint = f"`{command} --help` lists the arguments and options."
    if meant := _meant(message):
        hint = f"Did you mean {meant}? {hint}"
    return fail("USAGE", message, EXIT_BAD_INPUT, hint)


def _meant(message: str) -> str | None:
    if (unknown := _UNKNOWN.search(message)) and unknown[1] in _RENAMED:
        return _RENAMED[unknown[1]]
    found = _CHOICES.search(message)
    if found is None:
        return None
    choices = re.findall(r"'([^']*)'", found.group(2))
    near = get_close_matches(found.group(1), choices, n=1)
    return near[0] if near else None
