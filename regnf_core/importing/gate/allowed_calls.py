"""The system calls that a conversion needs, and the arguments that some of them may have. All others are refused.

The list was made by watching imports of every family (``strace``, from the moment the filter holds), and by adding the
names under which another C library or processor asks for the same thing. It has no processes, no sockets,
no signals to others, no file's owner, mode, times or attributes, and nothing that one of its members can do instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_NEEDED = """
read               0  63  files
pread64           17  67  files: the loader of libraries
write              1  64  the field, the report
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

    def calls(self, threads: bool) -> Mapping[str, int]:
        """The number of each call on the list, with those that new threads need if they are allowed."""
        listed = _NEEDED + _FOR_THREADS if threads else _NEEDED
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
