"""What a hijacked conversion would try. Each attempt, run in a child, ends in "done" or the name of an error number.

``BY_LAYER`` names those that a confinement stops on its own. None does harm where nothing stops it.
"""

from __future__ import annotations

import ctypes
import errno
import os
import resource
import signal
import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

Where = dict[str, Any]
"""port, unix (a path), abstract (a name), parent, secret_at (an address in the parent), store (a folder), secret (a
file of it), home (the child's own folder)."""
Attempt = Callable[[Where], object]
_libc = ctypes.CDLL(None, use_errno=True)
_PTRACE_SEIZE, _AT_FDCWD = 0x4206, -100


def outcome(attempt: Attempt, where: Where) -> str:
    """How one attempt ended."""
    try:
        attempt(where)
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return "done"


def call(number: int, *arguments: Any) -> int:
    """A system call by its number (x86-64). Raises OSError."""
    result = int(_libc.syscall(number, *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), f"system call {number}")
    return result


def connect(family: int, address: Any) -> None:
    with socket.socket(family) as made:
        made.settimeout(5)
        made.connect(address)


def fork() -> None:
    if (child := os.fork()) == 0:
        os._exit(0)
    os.waitpid(child, 0)


def read_parents_memory(where: Where) -> None:
    with open(f"/proc/{where['parent']}/mem", "rb", buffering=0) as memory:
        memory.seek(where["secret_at"])
        memory.read(8)


def copy_parents_memory(where: Where) -> None:
    here = ctypes.create_string_buffer(8)
    pair = ctypes.c_uint64 * 2
    local, remote = pair(ctypes.addressof(here), 8), pair(where["secret_at"], 8)
    call(310, where["parent"], ctypes.byref(local), 1, ctypes.byref(remote), 1, 0)


def take_parents_file(where: Where) -> None:
    opened = os.pidfd_open(where["parent"])
    try:
        os.close(call(438, opened, 0, 0))
    finally:
        os.close(opened)


def own_user_namespace() -> None:
    """In a thread, which may not have one: EINVAL says that the call itself was allowed."""
    ended: list[OSError] = []

    def leave() -> None:
        try:
            call(272, 0x10000000)
        except OSError as error:
            ended.append(error)

    thread = threading.Thread(target=leave)
    try:
        thread.start()
        thread.join()
    except RuntimeError:  # no threads here
        leave()
    if ended and ended[0].errno != errno.EINVAL:
        raise ended[0]


def asynchronous_requests() -> None:
    context = ctypes.c_ulong()
    call(206, 1, ctypes.byref(context))
    call(207, context)


def watch_a_folder(where: Where) -> None:
    watching = call(253)
    try:
        call(254, watching, where["store"].encode(), 2)
    finally:
        os.close(watching)


def set_attribute(where: Where) -> None:
    """By the call of 2025, with an attribute that root and others may set."""
    value = ctypes.create_string_buffer(b"x")
    arguments = struct.pack("=QII", ctypes.addressof(value), 1, 0)
    call(463, _AT_FDCWD, where["secret"].encode(), 0, b"user.regnf", arguments, len(arguments))
    call(466, _AT_FDCWD, where["secret"].encode(), 0, b"user.regnf")


def change_flags(where: Where) -> None:
    """By the call of 2025: the file's flags as they are."""
    attributes = ctypes.create_string_buffer(24)
    call(468, _AT_FDCWD, where["secret"].encode(), attributes, 24, 0)
    call(469, _AT_FDCWD, where["secret"].encode(), attributes, 24, 0)


def start_a_thread() -> None:
    thread = threading.Thread(target=int)
    try:
        thread.start()
    except RuntimeError as error:  # what Python makes of any refusal
        raise OSError(errno.EPERM, str(error)) from error
    thread.join()


def read(path: str | Path) -> bytes:
    return Path(path).read_bytes()


def move_out(where: Where) -> None:
    source, target = Path(where["home"], "mine"), Path(where["store"], "mine")
    source.write_bytes(b"")
    try:
        source.rename(target)
    finally:
        source.unlink(missing_ok=True)
    target.unlink()


def make(name: str, made: Callable[[Path], object], undo: Callable[[Path], object] = Path.unlink) -> Attempt:
    """Something new in the store, or at an absolute path, and away again."""

    def attempt(where: Where) -> None:
        path = Path(where["store"], name)
        made(path)
        undo(path)

    return attempt


NETWORK: dict[str, Attempt] = {
    "connect to a port": lambda w: connect(socket.AF_INET, ("127.0.0.1", w["port"])),
    "connect to a socket in the file system": lambda w: connect(socket.AF_UNIX, w["unix"]),
    "connect to an abstract socket": lambda w: connect(socket.AF_UNIX, w["abstract"]),
    "send a datagram": lambda w: socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", ("127.0.0.1", w["port"])),
    "listen": lambda _: socket.create_server(("127.0.0.1", 0)).close(),
    "make a pair of sockets": lambda _: [end.close() for end in socket.socketpair()],
}
PROCESSES: dict[str, Attempt] = {
    "fork": lambda _: fork(),
    "start a program": lambda _: os.waitpid(os.posix_spawn("/bin/true", ["true"], {}), 0),
    "signal the parent": lambda w: os.kill(w["parent"], 0),
    "signal a thread of the parent": lambda w: call(234, w["parent"], w["parent"], 0),
    "queue a signal to the parent": lambda w: call(
        297, w["parent"], w["parent"], 0, ctypes.byref((ctypes.c_int * 32)(0, 0, -1))
    ),
    "open the parent by its number": lambda w: os.close(os.pidfd_open(w["parent"])),
    "signal its own group": lambda w: os.killpg(0, 0),
    "change the parent's limits": lambda w: resource.prlimit(
        w["parent"], resource.RLIMIT_NOFILE, resource.prlimit(w["parent"], resource.RLIMIT_NOFILE)
    ),
    "change the parent's priority": lambda w: os.setpriority(
        os.PRIO_PROCESS, w["parent"], os.getpriority(os.PRIO_PROCESS, w["parent"])
    ),
    "bind the parent to a core": lambda w: os.sched_setaffinity(w["parent"], os.sched_getaffinity(w["parent"])),
    "share memory by a key": lambda _: call(31, call(29, 0, 4096, 0o1600), 0, None),  # made and marked for removal
    "make a message queue": lambda _: call(71, call(68, 0, 0o1600), 0, None),
    "make a user namespace": lambda _: own_user_namespace(),
    "start a thread": lambda _: start_a_thread(),
    # what ends this process with its parent is taken back, and put there again
    "outlive the parent": lambda _: [call(157, 1, number, 0, 0, 0) for number in (0, signal.SIGKILL)],
    "make a file in memory": lambda _: os.close(os.memfd_create("regnf")),
    "look at memory segments": lambda _: call(154, 0, ctypes.create_string_buffer(8), 8),  # modify_ldt, to read
    "open a tree of files": lambda w: os.close(call(428, _AT_FDCWD, w["store"].encode(), 0)),
    "make asynchronous requests": lambda _: asynchronous_requests(),
    "watch a folder": watch_a_folder,
}
LOOKING: dict[str, Attempt] = {
    # without stopping it; ends with this process
    "trace the parent": lambda w: call(101, _PTRACE_SEIZE, w["parent"], 0, 0),
    "read the parent's memory through a file": read_parents_memory,
    "read the parent's memory through a call": copy_parents_memory,
    "take an open file from the parent": take_parents_file,
}
PEEPING: dict[str, Attempt] = {
    "read the parent's environment": lambda w: read(f"/proc/{w['parent']}/environ"),
    "read the parent's command line": lambda w: read(f"/proc/{w['parent']}/cmdline"),
    "list the parent's open files": lambda w: os.listdir(f"/proc/{w['parent']}/fd"),
}
FILES: dict[str, Attempt] = {
    "read a file of the store": lambda w: read(w["secret"]),
    "list the store": lambda w: os.listdir(w["store"]),
    "read the system's users": lambda w: read("/etc/passwd"),
    "list the root": lambda w: os.listdir("/"),
    "write to the store": make("new", lambda path: path.write_bytes(b"x")),
    "append to a file of the store": lambda w: Path(w["secret"]).open("ab").close(),
    "cut a file of the store": lambda w: os.truncate(w["secret"], os.path.getsize(w["secret"])),
    "move a file into the store": move_out,
    # a second name, in its own folder
    "link a file of the store": lambda w: [os.link(w["secret"], f"{w['home']}/new"), os.unlink(f"{w['home']}/new")],
    "make a folder": make("folder", Path.mkdir, Path.rmdir),
    "make a symbolic link": make("symbolic", lambda path: path.symlink_to("/etc/passwd")),
    "write to a common temporary folder": make(f"/tmp/regnf-{os.getpid()}", lambda path: path.write_bytes(b"x")),
}
ATTRIBUTES: dict[str, Attempt] = {
    "change a mode": lambda w: os.chmod(w["secret"], os.stat(w["secret"]).st_mode & 0o777),
    "change an owner": lambda w: os.chown(w["secret"], -1, -1),
    "change a time": lambda w: os.utime(w["secret"]),
    "set an attribute": set_attribute,
    "change a file's flags": change_flags,
}
ATTEMPTS = NETWORK | PROCESSES | LOOKING | PEEPING | FILES | ATTRIBUTES
BY_LAYER: dict[str, set[str]] = {
    "filter": {*NETWORK, *PROCESSES, *ATTRIBUTES, *LOOKING} - {"read the parent's memory through a file"},
    "landlock": {*PEEPING, *FILES, *LOOKING},
    "everything": set(ATTEMPTS),
}
"""Which attempts fail with the layer alone: "filter" the system call filter, "landlock" Landlock, "everything" all."""
NOT_EVERYWHERE = {*LOOKING, *ATTRIBUTES, "look at memory segments"}
"""What some systems forbid without any confinement of ours, or do not have yet."""


def run_all(where: Where) -> dict[str, str]:
    """Every attempt's outcome."""
    return {name: outcome(attempt, where) for name, attempt in ATTEMPTS.items()}
