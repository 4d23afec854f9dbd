"""Every system call, made natively under the filter, each in a process of its own: how each of them ended.

    python -m tests.core.importing.gate.native_calls FIRST COUNT

Prints a JSON list: a result from 0, an error number from 1 to 4095 as its negative, or "signal N". ``trap`` is the call
in the manner of 32-bit x86. The process forks before the filter holds, since afterwards it could not.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

from regnf_core.importing.gate.sandbox import refuse_system_calls

_PR_SET_NO_NEW_PRIVS = 38
_HANGS_AFTER_S = 20
_INT_80 = bytes.fromhex("b814000000cd80c3")
"""mov eax, 20 (getpid); int 0x80; ret"""
libc = ctypes.CDLL(None, use_errno=True)
libc.syscall.restype = ctypes.c_long


def call(number: int, *arguments: int) -> int:
    """The result, or the error number as its negative."""
    values = [ctypes.c_long(value) for value in (*arguments, 0, 0, 0, 0, 0, 0)[:6]]
    result = int(libc.syscall(ctypes.c_long(number), *values))
    return -ctypes.get_errno() if result == -1 else result


def apart(action: Callable[[], int], threads: bool = False) -> int | str:
    """How ``action`` ends under the filter, in a process that is thrown away."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(_HANGS_AFTER_S)
        libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        if not refuse_system_calls(threads):
            os._exit(3)
        os.write(write_end, str(action()).encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end) as told:
        said = told.read()
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return f"signal {os.WTERMSIG(status)}"
    return int(said) if said else f"exit {os.WEXITSTATUS(status)}"


def trap() -> Callable[[], int]:
    """A call through the door of 32-bit programs."""
    code = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    code.write(_INT_80)
    view = (ctypes.c_char * mmap.PAGESIZE).from_buffer(code)
    enter = ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(view))

    def run() -> int:
        assert view
        return int(enter())

    return run


def main(arguments: list[str]) -> None:
    if arguments == ["trap"]:
        ended = [apart(trap())]
    else:
        first, count = map(int, arguments)
        ended = [apart(partial(call, number)) for number in range(first, first + count)]
    sys.stdout.write(json.dumps(ended))


if __name__ == "__main__":
    main(sys.argv[1:])
