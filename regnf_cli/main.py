"""The command ``regnf``: gathers the sub-commands and turns errors into exit codes.

Exit codes: 0 registered (or done) · 4 ambiguous · 1 rejected · 2 bad input · 3 service unavailable · 130 interrupted.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import Annotated

import typer

from regnf_cli.console import EXIT_BAD_INPUT, EXIT_UNAVAILABLE, fail
from regnf_cli.convert import convert
from regnf_cli.demo import demo
from regnf_cli.fit import fit
from regnf_cli.inspect import inspect
from regnf_cli.register import register
from regnf_cli.render_dataset import render_dataset
from regnf_cli.search import search
from regnf_cli.serve import serve
from regnf_cli.worker import worker
from regnf_core import __version__
from regnf_core.errors import RegnfError

app = typer.Typer(
    name="regnf",
    help="Register neural signed distance fields: find the transform that lays a scene's object onto a library's.",
    epilog="Exit codes: 0 registered or done, 4 ambiguous, 1 rejected, 2 bad input, 3 service unavailable.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and leave.", is_eager=True)] = False,
) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


for command in (demo, register, search, serve, worker, inspect, convert, fit):
    app.command(command.__name__)(command)
app.command("render-dataset")(render_dataset)


def main() -> None:
    """Entry point of the console script."""
    # Threads that spin while they wait make two torch processes on one machine ten times slower. Read when torch loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        app(standalone_mode=True)
    except RegnfError as error:
        code = EXIT_UNAVAILABLE if getattr(error, "unavailable", False) else EXIT_BAD_INPUT
        sys.exit(fail(error.reason, str(error), code))
    except FileNotFoundError as error:
        sys.exit(fail("FILE_NOT_FOUND", f"no such file: {error.filename}"))
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        sys.exit(fail("FILE_UNUSABLE", str(error)))


if __name__ == "__main__":
    main()
