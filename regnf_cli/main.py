"""The command ``regnf``: runs the sub-command that is requested and turns errors into exit codes.

Exit codes: 0 registered (or done) · 4 ambiguous · 1 rejected · 2 bad input · 3 service unavailable ·
70 an error of regnf itself ·
128 + N ended by signal N: 130 by Ctrl+C, 143 by SIGTERM, 129 by SIGHUP, 141 because nobody reads the output any more.

Only Python's own modules are loaded with this one: a signal that comes while others load is to end the command quietly.
"""

from __future__ import annotations

import atexit
import errno
import gc
import os
import signal
import sys

_ONE_THREAD = {"register", "search", "render", "edit"}
_COLLECT_AFTER = 20_000
"""Objects between two collections of garbage. With Python's 700 they take 0.06 s of the time in which torch loads."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_AFTER_S = 0.1
"""When an interrupt that something has swallowed comes again."""
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_CLOSED = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
_OUTPUT = frozenset({*_FULL, *_CLOSED, errno.EIO, None})
"""What a write that names no file fails with; numpy and PIL give no number either."""


def main() -> None:
    """Entry point of the console script. The process ends here, without the interpreter's own last steps.

    These walk all that torch has made (0.4 s), and compiled libraries that are cut off in their work complain of what
    is left over (nanobind: "leaked function"). What was registered to be done at the exit is done.
    """
    ended_by: list[int] = []
    code = 128 + signal.SIGINT
    try:
        _turn_signals_into_interrupts(ended_by)
        code = command(ended_by)
    except KeyboardInterrupt:
        pass
    except Exception:  # noqa: BLE001 - it is told as Python would
        sys.excepthook(*sys.exc_info())
        code = os.EX_SOFTWARE
    for number in (*_SIGNALS, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)
    atexit._run_exitfuncs()
    os._exit(128 + ended_by[0] if ended_by else code)


def command(ended_by: list[int] | None = None) -> int:
    """Run what ``sys.argv`` asks for; the exit code. ``ended_by``: where the signals' numbers are put as they come."""
    _set_threads()
    gc.set_threshold(_COLLECT_AFTER)
    try:
        code = _run()
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        return code
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:
        return 128 + signal.SIGPIPE
    except SystemExit as error:
        if error.code != 1:
            raise
        return 128 + signal.SIGPIPE  # rich makes this of a closed pipe, and nothing else does
    except OSError as error:
        if ended_by:
            return 128 + signal.SIGINT
        if error.filename is None and error.errno not in _OUTPUT:
            raise
        from regnf_cli.report import fail

        told = error.strerror or str(error)
        return fail("FILE_UNUSABLE", f"{error.filename or 'output'}: {told}", hint=_what_to_do(error.errno))
    except BaseException:
        if ended_by:  # a compiled library has made another error of the interrupt
            return 128 + signal.SIGINT
        raise


def _set_threads() -> None:
    """How many threads torch starts, and how they wait; read when it loads. What the user set stays.

    Busy waiting of idle threads makes two torch processes on one machine ten times slower. Waking them takes longer
    than the small operations of most commands, which are faster with one thread (docs/capacity.md).
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if set(sys.argv[1:2]) & _ONE_THREAD:
        os.environ.setdefault("OMP_NUM_THREADS", "1")


def _turn_signals_into_interrupts(ended_by: list[int]) -> None:
    """Let SIGTERM and SIGHUP do what Ctrl-C does, so that no scratch files are left. Each is put into ``ended_by``.

    Commands that serve set handlers of their own. What was ignored from the start, by nohup for instance, stays so.
    """

    def end(number: int, _: object) -> None:
        if number != signal.SIGALRM:
            ended_by.append(number)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_AFTER_S, _AGAIN_AFTER_S)
        elif _is_unwinding(sys.exception()):
            return
        raise KeyboardInterrupt

    def unraisable(given: sys.UnraisableHookArgs) -> None:
        if not isinstance(given.exc_value, KeyboardInterrupt):
            sys.__unraisablehook__(given)

    for number in _SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, end)
    signal.signal(signal.SIGALRM, end)
    sys.unraisablehook = unraisable


def _is_unwinding(handled: BaseException | None) -> bool:
    """Whether the interrupt is on its way. Finalizers, and libraries that try whether another is there, swallow it."""
    while handled is not None and not isinstance(handled, KeyboardInterrupt):
        handled = handled.__context__
    return handled is not None


def _run() -> int:
    """Run the command that the arguments name; the exit code. Errors of users take two lines."""
    import typer

    from regnf_cli.commands import COMMANDS, GROUPS, app_of, usage_fault
    from regnf_cli.report import EXIT_BAD_INPUT, EXIT_UNAVAILABLE, fail, show_candidates
    from regnf_core.errors import HINTS, RegnfError

    usage_error: type[Exception] = typer.BadParameter.__mro__[1]  # typer does not export its name
    asked = sys.argv[1:2]
    app = app_of(asked) if set(asked) & {*COMMANDS, *GROUPS} else app_of()
    try:
        code = app(standalone_mode=False)
        return code if isinstance(code, int) else 0
    except usage_error as error:
        return usage_fault(error)
    except typer.Abort as error:
        raise KeyboardInterrupt from error
    except RegnfError as error:
        code = EXIT_UNAVAILABLE if getattr(error, "unavailable", False) else EXIT_BAD_INPUT
        hint = error.hint
        if hint == HINTS["INVALID_OPTIONS"] and "options." not in str(error):  # options of the command line
            hint = f"`regnf {asked[0]} --help` lists the arguments and options."
        fail(error.reason, str(error), code, hint)
        show_candidates(error)
        return code
    except FileNotFoundError as error:
        return fail("FILE_NOT_FOUND", f"{error.filename}: no such file", hint="Check the path.")


def _what_to_do(number: int | None) -> str | None:
    if number in _CLOSED:
        return "Check the permissions, or give another path."
    return "Free space on the disk, or give another path." if number in (*_FULL, None) else None


if __name__ == "__main__":
    main()
