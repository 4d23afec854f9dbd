"""A seccomp filter that allows what a conversion needs and refuses every other system call (Linux, x86-64, 64-bit ARM).

What is not on the list fails with ENOSYS, as though this kernel did not have it: that is the answer on which libraries
fall back to an older call, so a C library of next year still works, and a call of next year is refused. A call on the
list with an argument that is not allowed fails with EPERM. Calls in the manner of another architecture (32-bit, x32),
which no library here makes, end the process. The filter holds for the rest of the process's life and for all threads.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct

from regnf_core.importing.gate.allowed_calls import MACHINES, Alternatives, Condition, Machine, conditions

_SECCOMP = {"x86_64": 317, "aarch64": 277}
_SET_MODE_FILTER, _ALL_THREADS = 1, 1
_LOAD_WORD, _AND, _JUMP_EQUAL, _JUMP_AT_LEAST, _JUMP, _RETURN = 0x20, 0x54, 0x15, 0x35, 0x05, 0x06
_ALLOW, _KILL, _ERROR = 0x7FFF0000, 0x80000000, 0x00050000
_EPERM, _ENOSYS = 1, 38
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16
_X32_BIT = 0x40000000


class _Program(ctypes.Structure):
    """struct sock_fprog."""

    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_void_p))


def refuse_system_calls(threads: bool = False) -> bool:
    """Install the filter. False where the kernel or the machine has none. Needs no_new_privs to be set.

    threads: allow new ones; never new processes.
    """
    machine = MACHINES.get(platform.machine())
    if machine is None:
        return False
    code = b"".join(filter_code(machine, os.getpid(), threads))
    buffer = ctypes.create_string_buffer(code, len(code))
    program = _Program(len(code) // 8, ctypes.cast(buffer, ctypes.c_void_p))
    syscall = ctypes.CDLL(None, use_errno=True).syscall
    number = _SECCOMP[platform.machine()]
    return bool(syscall(number, _SET_MODE_FILTER, _ALL_THREADS, ctypes.byref(program)) == 0)


def filter_code(machine: Machine, itself: int, threads: bool) -> list[bytes]:
    """The classic BPF program. The two numbers of a jump are how many instructions to skip if true, if false."""
    code = [_op(_LOAD_WORD, _ARCHITECTURE_AT), _op(_JUMP_EQUAL, machine.audit_code, 1, 0), _op(_RETURN, _KILL)]
    code += [_op(_LOAD_WORD, _NUMBER_AT)]
    if machine.has_x32:
        code += [_op(_JUMP_AT_LEAST, _X32_BIT, 0, 1), _op(_RETURN, _KILL)]
    restricted = conditions(machine, itself)
    for name, number in machine.calls(threads).items():
        body = _any_of(restricted[name]) if name in restricted else [_op(_RETURN, _ALLOW)]
        code += [_op(_JUMP_EQUAL, number, 0, len(body)), *body]
    return [*code, _op(_RETURN, _ERROR | _ENOSYS)]


def _any_of(alternatives: Alternatives) -> list[bytes]:
    """Allow the call if one alternative holds, else refuse it."""
    code = []
    for alternative in alternatives:
        part = [_op(_RETURN, _ALLOW)]
        for condition in reversed(alternative):
            part = _check(condition, beyond=len(part)) + part
        code += part
    return [*code, _op(_RETURN, _ERROR | _EPERM)]


def _check(condition: Condition, beyond: int) -> list[bytes]:
    """Go on if the condition holds, else skip ``beyond`` more instructions."""
    offset = _ARGUMENTS_AT + 8 * condition.argument + 4 * condition.high  # both architectures are little-endian
    count = len(condition.values)
    jumps = [_op(_JUMP_EQUAL, value, count - at, 0) for at, value in enumerate(condition.values)]
    return [_op(_LOAD_WORD, offset), _op(_AND, condition.mask), *jumps, _op(_JUMP, beyond)]


def _op(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    """struct sock_filter."""
    return struct.pack("=HBBI", code, if_true, if_false, value)
