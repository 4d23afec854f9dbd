"""The command ``regnf``: runs the sub-command that is asked for and turns errors into exit codes.

Exit codes: 0 registered (or done) · 4 ambiguous · 1 rejected · 2 bad input · 3 service unavailable · 130 interrupted ·
143 terminated.
"""

from __future__ import annotations

import errno
import gc
import os
import signal
import sys
from types import FrameType
from typing import cast

import typer

from regnf_cli.commands import COMMANDS, GROUPS, app_of
from regnf_cli.console import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED, EXIT_UNAVAILABLE, fail
from regnf_cli.usage import usage_fault
from regnf_core.errors import RegnfError

_ONE_THREAD = {"register", "search", "render", "edit"}
_COLLECT_AFTER = 20_000
"""Objects between two collections of garbage. With Python's 700 they take .06 s of the time in which torch loads."""
_UsageError = cast(type[Exception], typer.BadParameter.__mro__[1])
"""What typer raises for arguments that it cannot use; it does not export the name."""


def main() -> None:
    """Entry point of the console script."""
    _set_threads()
    ended_by: list[int] = []
    _clean_up_when_terminated(ended_by)
    gc.set_threshold(_COLLECT_AFTER)
    code = _run()
    gc.freeze()  # the interpreter's last collection would walk all that torch has made: .4 s
    sys.exit(EXIT_TERMINATED if ended_by and code == EXIT_INTERRUPTED else code)


def _set_threads() -> None:
    """How many threads torch starts, and how they wait; read when it loads. What the user set stays.

    Busy waiting of idle threads makes two torch processes on one machine ten times slower. Waking them takes longer
    than the small operations of most commands, which are faster with one thread (docs/capacity.md).
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if set(sys.argv[1:2]) & _ONE_THREAD:
        os.environ.setdefault("OMP_NUM_THREADS", "1")


def _clean_up_when_terminated(ended_by: list[int]) -> None:
    """Let SIGTERM do what Ctrl-C does, so that no scratch files are left. The signal is put into ``ended_by``.

    Commands that serve set handlers of their own.
    """

    def end(number: int, _: FrameType | None) -> None:
        ended_by.append(number)
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, end)


def _run() -> int:
    """Run the command that the arguments name; the exit code. Errors of users take two lines."""
    asked = sys.argv[1:2]
    app = app_of(asked) if set(asked) & {*COMMANDS, *GROUPS} else app_of()
    try:
        code = app(standalone_mode=False)
        return code if isinstance(code, int) else 0
    except _UsageError as error:
        return usage_fault(error)
    except (typer.Abort, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    except RegnfError as error:
        code = EXIT_UNAVAILABLE if getattr(error, "unavailable", False) else EXIT_BAD_INPUT
        from regnf_cli.candidates import show_candidates

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
