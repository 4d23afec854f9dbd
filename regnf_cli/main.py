"""The command ``regnf``: gathers the sub-commands and turns errors into exit codes.

Exit codes: 0 registered (or done) · 4 ambiguous · 1 rejected · 2 bad input · 3 service unavailable · 130 interrupted.
"""

from __future__ import annotations

import errno
import os
import sys
from typing import Annotated, cast

import typer

from regnf_cli.candidates import show_candidates
from regnf_cli.console import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_UNAVAILABLE, fail
from regnf_cli.convert import convert
from regnf_cli.demo import demo
from regnf_cli.fit import fit
from regnf_cli.inspect import inspect
from regnf_cli.register import register
from regnf_cli.render_dataset import render_dataset
from regnf_cli.search import search
from regnf_cli.serve import serve
from regnf_cli.usage import usage_fault
from regnf_cli.worker import worker
from regnf_core import __version__
from regnf_core.errors import RegnfError

_UsageError = cast(type[Exception], typer.BadParameter.__mro__[1])
"""What typer raises for arguments that it cannot use; it does not export the name."""
app = typer.Typer(
    name="regnf",
    help="Register neural signed distance fields: find where a known object stands in a scanned room.",
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
    # Busy waiting of idle threads makes two torch processes on one machine ten times slower. Read when torch loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.exit(_run())


def _run() -> int:
    """Run the command that the arguments name; the exit code. Errors of users take two lines."""
    try:
        code = app(standalone_mode=False)
        return code if isinstance(code, int) else 0
    except _UsageError as error:
        return usage_fault(error)
    except (typer.Abort, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    except RegnfError as error:
        code = EXIT_UNAVAILABLE if getattr(error, "unavailable", False) else EXIT_BAD_INPUT
        fail(error.reason, str(error), code, error.hint)
        show_candidates(error)
        return code
    except FileNotFoundError as error:
        return fail("FILE_NOT_FOUND", f"{error.filename}: no such file", hint="Check the path.")
    except OSError as error:
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        return fail("FILE_UNUSABLE", str(error), hint=_what_to_do(error.errno))


def _what_to_do(number: int | None) -> str | None:
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "Check who may write there, or name another place."
    return "Make room on the disk, or name another place." if number == errno.ENOSPC else None


if __name__ == "__main__":
    main()
