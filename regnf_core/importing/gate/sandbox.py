"""The first lines of the throw-away process: before it sees the upload it gives up all it does not need."""

from __future__ import annotations

import ctypes
import math
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from regnf_core.importing.gate.child import LONGEST
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.processes import die_with_parent

# The system calls that a conversion needs, and the arguments that some of them may have. All others are refused.
#
# The list was made by watching imports of every family (``strace``, from the moment the filter holds), and by adding
# the names under which another C library or processor asks for the same object. It has no processes, no sockets, no
# signals to others, no file's owner, mode, times or attributes, and nothing that one of its members can do instead.

_NEEDED = """
read               0  63  files
pread64           17  67  files: the loader of libraries
write              1  64  the field, the report
writev            20  66  the same, as the C++ library asks for it: OpenCASCADE's triangles
lseek              8  62  files
close              3  57  files
open               2   -  files: as Landlock allows
openat           257  56  files: as Landlock allows
fstat              5  80  files: their size
stat               4   -  imports look for modules
lstat              6   -  imports look for modules
newfstatat       262  79  imports look for modules
statx            332 291  imports look for modules
access            21   -  imports look for modules
faccessat        269  48  imports look for modules
readlink          89   -  paths of libraries
readlinkat       267  78  paths of libraries
getdents64       217  61  imports list folders
getcwd            79  17  relative paths
fadvise64        221 223  the field is read once, from its beginning
fsync             74  82  the field is on the disk before it gets its name
rename            82   -  the field gets its name
renameat         264  38  the field gets its name
unlink            87   -  what an interrupted write has left
unlinkat         263  35  what an interrupted write has left
fcntl             72  25  a second descriptor of an open file
ioctl             16  29  whether a file is a terminal
brk               12 214  memory
mmap               9 222  memory, the upload, libraries
mprotect          10 226  memory, libraries once they are loaded
munmap            11 215  memory
mremap            25 216  memory that grows
madvise           28 233  memory: large pages, pages given back
futex            202  98  locks of libraries
rt_sigaction      13 134  Python's handlers
rt_sigprocmask    14 135  the C library's abort
rt_sigreturn      15 139  the end of a handler
sigaltstack      131 132  a handler's stack
restart_syscall  219 128  a wait goes on after a handler
tgkill           234 131  abort: a signal to itself
getpid            39 172  its own number
gettid           186 178  its own number
getuid           102 174  the interpreter
geteuid          107 175  the interpreter
getgid           104 176  the interpreter
getegid          108 177  the interpreter
getrusage         98 165  processor time
prlimit64        302 261  its own limits, to read
sysinfo           99 179  how much memory there is
uname             63 160  which kernel it is
getrandom        318 278  the name of a temporary file, hash seeds
clock_gettime    228 113  time, where it is not read from shared memory
clock_getres     229 114  time
gettimeofday      96 169  time
time             201   -  time
clock_nanosleep  230 115  a wait, until the time is over at most
sched_yield       24 124  locks of libraries
sched_getaffinity 204 123 how many cores there are
sched_setaffinity 203 122 the arithmetic libraries bind themselves to cores
getcpu           309 168  which core it is, where that is not read from shared memory
exit              60  93  the end
exit_group       231  94  the end
"""
"""Name, number on x86-64, number on 64-bit ARM (which has not the calls that others have replaced), what for."""
_FOR_THREADS = """
clone             56 220  a new thread
set_robust_list  273  99  a new thread's locks
rseq             334 293  a new thread
"""
"""In addition where a library cannot do without threads: the surface through a cloud of points."""
_FOR_FOLDERS = """
mkdir             83   -  a folder of a recording's archive
mkdirat          258  34  a folder of a recording's archive
"""
"""In addition where an archive of files is unpacked into its folders."""

_PROT_WRITE, _PROT_EXEC, _MAP_ANONYMOUS = 2, 4, 0x20
_FUTEX_FLAGS = 128 | 256
_FUTEX_OPERATIONS = (0, 1, 9, 10)
_SPECIAL_MODES = 0o7000
_TCGETS, _TIOCGWINSZ, _FIOCLEX, _FIONCLEX = 0x5401, 0x5413, 0x5451, 0x5450
_F_DUPFD, _F_GETFD, _F_SETFD, _F_GETFL, _F_DUPFD_CLOEXEC = 0, 1, 2, 3, 1030
_ADVICE = (0, 1, 2, 3, 4, 8, 14, 15, 16)
_ALL = 0xFFFFFFFF
_THREAD_FLAGS = (0x3D0F00, 0x7D0F00)
"""What the C libraries (glibc, musl) ask for with a new thread: it shares all there is, and no namespace is new."""


@dataclass(frozen=True)
class Condition:
    """The word of ``argument`` (its low one unless ``high``) and ``mask`` is one of ``values``."""

    argument: int
    values: tuple[int, ...]
    mask: int = _ALL
    high: bool = False


Alternatives = tuple[tuple[Condition, ...], ...]
"""A call is allowed if all conditions of one alternative hold."""


@dataclass(frozen=True)
class Machine:
    """What the filter must know of a processor architecture."""

    audit_code: int
    column: int
    has_x32: bool
    relocates_code: bool
    """Whether the loader marks code as executable after it has mapped it (branch targets on ARM)."""

    def calls(self, threads: bool, folders: bool = False) -> Mapping[str, int]:
        """The number of each call on the list, with those that new threads and folders need, if they are allowed."""
        listed = _NEEDED + threads * _FOR_THREADS + folders * _FOR_FOLDERS
        rows = (line.split() for line in listed.splitlines() if line)
        return {row[0]: int(row[self.column]) for row in rows if row[self.column] != "-"}


MACHINES = {
    "x86_64": Machine(0xC000003E, column=1, has_x32=True, relocates_code=False),
    "aarch64": Machine(0xC00000B7, column=2, has_x32=False, relocates_code=True),
}


def conditions(machine: Machine, itself: int) -> Mapping[str, Alternatives]:
    """The calls on the list that are allowed with some arguments only. ``itself``: this process's number."""
    code = (_PROT_EXEC,) if machine.relocates_code else ()
    return {
        # A file that others would run with its owner's rights.
        "open": ((Condition(2, (0,), _SPECIAL_MODES),),),
        "openat": ((Condition(3, (0,), _SPECIAL_MODES),),),
        # Locks, leases, owners and notifications are not for a file that is only read or written.
        "fcntl": ((Condition(1, (_F_DUPFD, _F_GETFD, _F_SETFD, _F_GETFL, _F_DUPFD_CLOEXEC)),),),
        "ioctl": ((Condition(1, (_TCGETS, _TIOCGWINSZ, _FIOCLEX, _FIONCLEX)),),),
        # Code comes from files alone, and no page can be written and run at once.
        "mmap": (
            (Condition(2, (0,), _PROT_EXEC),),
            (Condition(2, (_PROT_EXEC,), _PROT_WRITE | _PROT_EXEC), Condition(3, (0,), _MAP_ANONYMOUS)),
        ),
        "mprotect": ((Condition(2, (0, _PROT_WRITE, *code), _PROT_WRITE | _PROT_EXEC),),),
        "madvise": ((Condition(2, _ADVICE),),),
        "futex": ((Condition(1, _FUTEX_OPERATIONS, _ALL & ~_FUTEX_FLAGS),),),
        "tgkill": ((Condition(0, (itself,)),),),
        "prlimit64": ((Condition(0, (0, itself)), Condition(2, (0,)), Condition(2, (0,), high=True)),),
        "sched_getaffinity": ((Condition(0, (0, itself)),),),
        "sched_setaffinity": ((Condition(0, (0, itself)),),),
        "clone": ((Condition(0, _THREAD_FLAGS),),),
    }


# Landlock, by its three system calls: this process may read a few places, write to one folder, and nothing else.
#
# The kernel holds to it for the rest of the process's life (Linux 5.13 and later, where the module is switched on).
# Beyond files it forbids what its version knows of: TCP, other processes' abstract sockets, signals to them, and
# looking into them (/proc/<pid>/environ, /proc/<pid>/mem). The owner, the mode and the times of a file are not its
# concern.

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every architecture
_VERSION_FLAG, _PATH_BENEATH = 1, 1
_WRITE_FILE, _READ_FILE, _READ_DIR, _REMOVE_FILE, _MAKE_FOLDER, _MAKE_REGULAR, _TRUNCATE = (
    1 << bit for bit in (1, 2, 3, 5, 7, 8, 14)
)
_FILE_RIGHTS = {1: (1 << 13) - 1, 2: (1 << 14) - 1, 3: (1 << 15) - 1, 5: (1 << 16) - 1}
"""All rights of a version and those after it: naming a right is what forbids it."""
_NET_RIGHTS, _NET_SINCE = 0b11, 4
_SCOPES, _SCOPES_SINCE = 0b11, 6
_OF_FILES = _READ_FILE | _WRITE_FILE | _TRUNCATE
"""The rights that may be given to what is not a folder."""
_READ = _READ_FILE | _READ_DIR
_OWN = _READ | _WRITE_FILE | _REMOVE_FILE | _MAKE_REGULAR | _TRUNCATE

Place = int | Path
"""An open file descriptor, or a path."""


def restrict_files(readable: Iterable[Place], folder: Path, folders: bool = False) -> bool:
    """From now on this process reads ``readable``, and what lies below, and works in ``folder``; all else is refused.

    folders: it may make further ones there. Returns False, having changed nothing, where the kernel has no Landlock.
    Needs no_new_privs to be set, and to be called before there are other threads.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    version = libc.syscall(_CREATE_RULESET, None, 0, _VERSION_FLAG)
    if version < 1:
        return False
    handled = _FILE_RIGHTS[max(known for known in _FILE_RIGHTS if known <= version)]
    net, scopes = _NET_RIGHTS * (version >= _NET_SINCE), _SCOPES * (version >= _SCOPES_SINCE)
    ruleset = libc.syscall(_CREATE_RULESET, struct.pack("=QQQ", handled, net, scopes), 24, 0)
    if ruleset < 0:
        return False
    try:
        for place in readable:
            _allow(libc, ruleset, place, _READ & handled)
        _allow(libc, ruleset, folder, (_OWN | folders * _MAKE_FOLDER) & handled)
        return bool(libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, place: Place, rights: int) -> None:
    """Give the rights to the place and all below it. What cannot be opened needs no rule."""
    try:
        opened = place if isinstance(place, int) else os.open(place, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(opened):
            rights &= _OF_FILES
        if libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, opened), 0) != 0:
            raise OSError(ctypes.get_errno(), "a Landlock rule was refused")
    finally:
        if not isinstance(place, int):
            os.close(opened)


# A seccomp filter that allows what a conversion needs and refuses every other system call (Linux, x86-64, 64-bit
# ARM).
#
# What is not on the list fails with ENOSYS, as though this kernel did not have it: that is the answer on which
# libraries fall back to an older call, so a C library of next year still works, and a call of next year is refused. A
# call on the list with an argument that is not allowed fails with EPERM. Calls in the manner of another architecture
# (32-bit, x32), which no library here makes, end the process. The filter holds for the rest of the process's life and
# for all threads.

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


def refuse_system_calls(threads: bool = False, folders: bool = False) -> bool:
    """Install the filter. False where the kernel or the machine has none. Needs no_new_privs to be set.

    threads, folders: allow new ones; never new processes.
    """
    machine = MACHINES.get(platform.machine())
    if machine is None:
        return False
    code = b"".join(filter_code(machine, os.getpid(), threads, folders))
    buffer = ctypes.create_string_buffer(code, len(code))
    program = _Program(len(code) // 8, ctypes.cast(buffer, ctypes.c_void_p))
    syscall = ctypes.CDLL(None, use_errno=True).syscall
    number = _SECCOMP[platform.machine()]
    return bool(syscall(number, _SET_MODE_FILTER, _ALL_THREADS, ctypes.byref(program)) == 0)


def filter_code(machine: Machine, itself: int, threads: bool, folders: bool = False) -> list[bytes]:
    """The classic BPF program. The two numbers of a jump are how many instructions to skip if true, if false."""
    code = [_op(_LOAD_WORD, _ARCHITECTURE_AT), _op(_JUMP_EQUAL, machine.audit_code, 1, 0), _op(_RETURN, _KILL)]
    code += [_op(_LOAD_WORD, _NUMBER_AT)]
    if machine.has_x32:
        code += [_op(_JUMP_AT_LEAST, _X32_BIT, 0, 1), _op(_RETURN, _KILL)]
    restricted = conditions(machine, itself)
    for name, number in machine.calls(threads, folders).items():
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


_PR_GET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_NO_NEW_PRIVS = 2, 4, 38
_CLONE_NEWUSER, _CLONE_NEWNET, _CLONE_NEWIPC = 0x10000000, 0x40000000, 0x08000000
_CAPABILITY_VERSION = 0x20080522
_OPEN_FILES = 64
_SYSTEM = """
/usr/lib /usr/lib64 /usr/local/lib /usr/local/cuda /usr/share /lib /lib64 /nix/store
/etc/ld.so.cache /etc/localtime /etc/ssl/openssl.cnf /dev/null /dev/urandom
/proc/cpuinfo /proc/meminfo /proc/stat /sys/devices/system/cpu /sys/devices/system/node
"""
"""Where libraries are, and which facts about the machine they read as they load. No service keeps a secret there."""


def confine(
    limits: ImportLimits,
    parent_pid: int,
    opened: Sequence[int],
    folder: Path,
    threads: bool = False,
    folders: bool = False,
) -> dict[str, bool]:
    """Confine this process for the rest of its life; returns which confinements the kernel granted.

    ``opened`` are the files it was given, ``folder`` is where it may write. Resource limits always hold. A network
    namespace without interfaces and the system call filter each keep the process off the network; containers often
    forbid the first and allow the second. threads: allow new ones; whoever started this process counts them. folders:
    allow new ones in ``folder``.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    die_with_parent(parent_pid)
    _be_first_to_go()
    _limit_resources(limits, threads)
    libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    no_network = _leave_network(libc)
    no_capabilities = _drop_capabilities(libc)
    no_new_privileges = libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
    return {
        "dies_with_parent": _dies_with_parent(libc),
        "network_namespace": no_network,
        "no_capabilities": no_capabilities,
        "no_new_privileges": no_new_privileges,
        "files_restricted": no_new_privileges and restrict_files([*opened, *_readable()], folder, folders),
        "system_call_filter": no_new_privileges and refuse_system_calls(threads, folders),
    }


def _be_first_to_go() -> None:
    """Where the machine runs out of memory, the kernel ends this process before the worker or the service."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


def _dies_with_parent(libc: ctypes.CDLL) -> bool:
    """Asked last: some changes of privileges take the signal back. The filter then keeps it from being changed."""
    signal_number = ctypes.c_int()
    told = libc.prctl(_PR_GET_PDEATHSIG, ctypes.byref(signal_number), 0, 0, 0)
    return bool(told == 0 and signal_number.value == signal.SIGKILL)


def _readable() -> list[int | Path]:
    """What this process reads besides the upload: its own code, libraries, itself.

    The folder that the package lies in is left out: where the code runs from a checkout it may hold anything.
    """
    package = Path(__file__).resolve().parents[2]
    prefixes = (Path(prefix) / name for prefix in (sys.base_prefix, sys.prefix) for name in ("lib", "lib64"))
    on_path = (Path(entry) for entry in sys.path if entry and Path(entry).resolve() != package.parent)
    itself = os.open("/proc/self", os.O_PATH | os.O_DIRECTORY)  # kept open: a rule holds for this one node only
    return [itself, package, *prefixes, *on_path, *map(Path, _SYSTEM.split())]


def _leave_network(libc: ctypes.CDLL) -> bool:
    """Move to a network namespace of our own, which has no interface that is up."""
    kinds = _CLONE_NEWNET | _CLONE_NEWIPC
    if libc.unshare(kinds) == 0:
        return True
    return bool(libc.unshare(kinds | _CLONE_NEWUSER) == 0)


def _drop_capabilities(libc: ctypes.CDLL) -> bool:
    """Give up what root, or a user namespace of its own, would let this process do."""
    return bool(libc.capset(struct.pack("=Ii", _CAPABILITY_VERSION, 0), bytes(24)) == 0)


def _limit_resources(limits: ImportLimits, threads: bool) -> None:
    wanted = [
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_NOFILE, _OPEN_FILES),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_MSGQUEUE, 0),
        (resource.RLIMIT_SIGPENDING, 0),
    ]
    if limits.wall_s is not None:  # several threads need less time than they use of the processors
        wanted.append((resource.RLIMIT_CPU, math.ceil(LONGEST * limits.wall_s)))
    if not threads:  # the kernel counts those of all processes of the user, so it is none or no limit
        wanted.append((resource.RLIMIT_NPROC, 0))
    for kind, value in wanted:
        _, hard = resource.getrlimit(kind)
        highest = value + 1 if kind == resource.RLIMIT_CPU else value  # at the hard limit SIGKILL would hide the cause
        if hard != resource.RLIM_INFINITY:
            value, highest = min(value, hard), min(highest, hard)
        resource.setrlimit(kind, (value, highest))
