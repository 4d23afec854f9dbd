"""The filter lets through what is on its list and nothing else: by its program, and by the kernel itself."""

from __future__ import annotations

import errno
import json
import mmap
import os
import platform
import re
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from regnf_core.importing.gate.sandbox import MACHINES, Machine, conditions, filter_code
from tests.core.importing.gate.native_calls import apart, call

ROOT = Path(__file__).resolve().parents[4]
ALLOW, KILL, ERROR = 0x7FFF0000, 0x80000000, 0x00050000
ITSELF = 4711
BEYOND = 700
"""Further than any kernel's table goes."""
X32 = 0x40000000
UNFILTERED = {335: f"signal {signal.SIGILL}", 336: -errno.ENXIO}
"""uretprobe and uprobe: newer kernels ask no filter, and refuse them to all code but the kernel's own trampolines."""
HEADERS = ("/usr/include/x86_64-linux-gnu/asm/unistd_64.h", "/usr/include/asm/unistd_64.h")
native = pytest.mark.skipif(
    platform.machine() != "x86_64" or sys.platform != "linux", reason="the calls are made by x86-64 Linux's numbers"
)


def answer(machine: Machine, number: int, arguments: tuple[int, ...] = (), threads: bool = False, code: int = 0) -> int:
    """What the filter's program says: the kernel's own rules for the few instructions that it is made of."""
    words = struct.pack("=IIQ6Q", number, code or machine.audit_code, 0, *(*arguments, 0, 0, 0, 0, 0, 0)[:6])
    program = [struct.unpack("=HBBI", op) for op in filter_code(machine, ITSELF, threads)]
    at = accumulator = 0
    while True:
        operation, if_true, if_false, value = program[at]
        at += 1
        match operation:
            case 0x06:
                return int(value)
            case 0x20:
                (accumulator,) = struct.unpack_from("=I", words, value)
            case 0x54:
                accumulator &= value
            case 0x05:
                at += value
            case 0x15:
                at += if_true if accumulator == value else if_false
            case 0x35:
                at += if_true if accumulator >= value else if_false
            case _:
                raise AssertionError(f"instruction {operation:#x}")


@pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)
@pytest.mark.parametrize("threads", [False, True])
def test_no_number_beside_the_list_is_let_through(machine: Machine, threads: bool) -> None:
    numbers = {*range(BEYOND), 0xFFFFFFFF, *range(X32, X32 + BEYOND), *(1 << bit for bit in range(32))}
    let_through = {n for n in numbers if answer(machine, n, (0, 0, 0, 0, 0, 0), threads) != ERROR | errno.ENOSYS}
    listed = set(machine.calls(threads).values())
    assert {n for n in let_through if n < X32} == listed
    if machine.has_x32:
        assert {answer(machine, n, (), threads) for n in numbers if n >= X32} == {KILL}


@pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)
def test_another_architecture_ends_the_process(machine: Machine) -> None:
    for other in (0x40000003, 0xC000003E, 0xC00000B7, 0x40000028):
        if other != machine.audit_code:
            assert answer(machine, machine.calls(False)["read"], code=other) == KILL


HARMFUL: dict[str, list[tuple[int, ...]]] = {
    "open": [(0, 0o102, 0o4755), (0, 0o102, 0o2755)],
    "openat": [(0, 0, 0o102, 0o4755), (0, 0, 0o102, 0o1777)],
    "fcntl": [(0, command) for command in (4, 5, 6, 7, 8, 10, 1024, 1026, 1031, 1033)],
    "ioctl": [(0, command) for command in (0x5412, 0x541C, 0x8901, 0xB702, 0x40086602)],
    "mmap": [(0, 4096, 7, 0x22), (0, 4096, 6, 2), (0, 4096, 5, 0x22), (0, 4096, 4, 0x21)],
    "mprotect": [(0, 4096, 7), (0, 4096, 6)],
    "madvise": [(0, 4096, advice) for advice in (9, 12, 20, 22, 100, 101)],
    "futex": [(0, operation) for operation in (2, 3, 4, 5, 6, 7, 8, 11, 12, 13)],
    "tgkill": [(1, 1, 9), (0, 0, 0), (0xFFFFFFFF, 0, 9)],
    "prlimit64": [(1, 7, 0), (0, 7, 4096), (0, 7, 1 << 40), (ITSELF, 7, 1)],
    "sched_getaffinity": [(1,)],
    "sched_setaffinity": [(1,)],
    "clone": [(flags,) for flags in (0, 0x11, 0x4111, 0x10000, 0x3D2F00, 0x103D0F00, 0x403D0F00)],
}
NEEDED: dict[str, list[tuple[int, ...]]] = {
    "openat": [(0, 0, 0), (0, 0, 0o1102, 0o666)],
    "fcntl": [(0, 1030), (0, 1)],
    "ioctl": [(0, 0x5401)],
    "mmap": [(0, 4096, 3, 0x22), (0, 4096, 5, 0x802), (0, 4096, 1, 1), (0, 4096, 0, 0x4022)],
    "mprotect": [(0, 4096, 1), (0, 4096, 3), (0, 4096, 0)],
    "madvise": [(0, 4096, 4), (0, 4096, 14)],
    "futex": [(0, 129), (0, 128), (0, 0x189), (0, 0x18A)],
    "tgkill": [(ITSELF, 1, 6)],
    "prlimit64": [(0, 7, 0, 1), (ITSELF, 3, 0, 1)],
    "sched_setaffinity": [(0,)],
    "clone": [(0x3D0F00,)],
}


@pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES)
def test_a_listed_call_with_a_harmful_argument_is_refused(machine: Machine) -> None:
    calls = machine.calls(threads=True)
    assert set(HARMFUL) == set(conditions(machine, ITSELF))
    for name, cases in HARMFUL.items():
        for arguments in cases if name in calls else ():
            assert answer(machine, calls[name], arguments, threads=True) == ERROR | errno.EPERM, (name, arguments)
    for name, cases in NEEDED.items():
        for arguments in cases:
            assert answer(machine, calls[name], arguments, threads=True) == ALLOW, (name, arguments)


def test_code_is_never_made_executable_on_x86() -> None:
    assert answer(MACHINES["x86_64"], 10, (0, 4096, 5)) == ERROR | errno.EPERM


def kernels_table() -> dict[int, str]:
    """The numbers of this kernel's calls where its headers are installed, else numbers alone."""
    for header in filter(os.path.exists, HEADERS):
        found = re.findall(r"#define __NR_(\w+) (\d+)", Path(header).read_text())
        return {int(number): name for name, number in found}
    return {number: str(number) for number in range(480)}


def ended(first: int, count: int) -> list[int | str]:
    command = [sys.executable, "-m", "tests.core.importing.gate.native_calls", str(first), str(count)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    results: list[int | str] = json.loads(done.stdout)
    return results


@native
def test_every_call_of_the_kernels_table_that_is_not_listed_is_refused() -> None:
    """Called natively: newer calls than the headers know of are among the numbers beyond them."""
    names = kernels_table()
    listed = set(MACHINES["x86_64"].calls(False).values())
    assert set(names) - listed, "no table"
    results = dict(enumerate(ended(0, BEYOND)))
    assert not {n for n in results if results[n] == "exit 3"}, "the filter was not installed"
    refused = {n for n in results if results[n] in (-errno.ENOSYS, UNFILTERED.get(n))}
    passed = {f"{n} {names.get(n, '')}": results[n] for n in results if n not in listed | refused}
    assert passed == {}


@native
def test_calls_of_other_conventions_are_fatal() -> None:
    assert set(ended(X32, 48) + ended(X32 + 512, 48)) == {f"signal {signal.SIGSYS}"}
    command = [sys.executable, "-m", "tests.core.importing.gate.native_calls", "trap"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    assert json.loads(done.stdout) == [f"signal {signal.SIGSYS}"]


ATTACKS: dict[str, Callable[[], int]] = {
    "outlive the parent": partial(call, 157, 1, 0),
    "a file in memory": partial(call, 319, 0, 0),
    "threads as processes": partial(call, 56, signal.SIGCHLD),
    "a thread": partial(call, 56, 0x3D0F00),
    "a new process by clone3": partial(call, 435, 0, 88),
    "its own session": partial(call, 112),
    "its own group": partial(call, 109, 0, 0),
    "a signal to all": partial(call, 62, -1, 0),
    "code in memory": partial(call, 9, 0, mmap.PAGESIZE, 5, 0x22, -1, 0),
    "higher limits": partial(call, 302, 0, 7, 1, 0),
    "a set-user-ID file": partial(call, 257, -100, 0, 0o102, 0o4755),
}


@native
@pytest.mark.parametrize("name", ATTACKS)
def test_the_kernel_refuses_it(name: str) -> None:
    assert apart(ATTACKS[name]) in (-errno.EPERM, -errno.ENOSYS)
