"""A seccomp filter for a process that computes and writes files, and nothing else (Linux, x86-64 and 64-bit ARM).

No sockets, no other programs, no child processes, no signals to others, no namespaces, no tracing, no shared memory or
messages, no say in other processes' limits and priorities, no change to a file's owner, mode or times. Threads are
allowed. The refused calls fail with EPERM. The filter holds for the rest of the process's life.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from dataclasses import dataclass

_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 22, 2
_LOAD_WORD, _JUMP_EQUAL, _JUMP_AT_LEAST, _JUMP_ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _KILL, _ERROR = 0x7FFF0000, 0x80000000, 0x00050000
_EPERM, _ENOSYS = 1, 38
_CLONE_THREAD = 0x00010000
_NUMBER_AT, _ARCHITECTURE_AT, _FIRST_ARGUMENT_AT = 0, 4, 16
_X32_BIT = 0x40000000

_REFUSED = """
socket 41 198
socketpair 53 199
connect 42 203
bind 49 200
listen 50 201
accept 43 202
execve 59 221
execveat 322 281
fork 57 -
vfork 58 -
kill 62 129
tkill 200 130
rt_sigqueueinfo 129 138
rt_tgsigqueueinfo 297 240
ptrace 101 117
unshare 272 97
setns 308 268
mount 165 40
bpf 321 280
io_uring_setup 425 425
process_vm_readv 310 270
process_vm_writev 311 271
keyctl 250 219
add_key 248 217
request_key 249 218
userfaultfd 323 282
perf_event_open 298 241
pidfd_open 434 434
pidfd_getfd 438 438
pidfd_send_signal 424 424
process_madvise 440 440
process_mrelease 448 448
kcmp 312 272
sched_setparam 142 118
sched_setscheduler 144 119
sched_setattr 314 274
setpriority 141 140
ioprio_set 251 30
migrate_pages 256 238
move_pages 279 239
chmod 90 -
fchmod 91 52
fchmodat 268 53
fchmodat2 452 452
chown 92 -
fchown 93 55
lchown 94 -
fchownat 260 54
setxattr 188 5
lsetxattr 189 6
fsetxattr 190 7
removexattr 197 14
lremovexattr 198 15
fremovexattr 199 16
utime 132 -
utimes 235 -
futimesat 261 -
utimensat 280 88
shmget 29 194
shmat 30 196
shmctl 31 195
semget 64 190
semop 65 193
semctl 66 191
semtimedop 220 192
msgget 68 186
msgsnd 69 189
msgrcv 70 188
msgctl 71 187
mq_open 240 180
mq_unlink 241 181
syslog 103 116
"""
"""Name, number on x86-64, number on 64-bit ARM (which has not the calls that others have replaced)."""


@dataclass(frozen=True)
class _Machine:
    """What the filter must know of a processor architecture."""

    audit_code: int
    column: int
    clone: int
    tgkill: int
    prlimit: int
    set_affinity: int
    has_x32: bool

    @property
    def refused(self) -> list[int]:
        """Numbers of the refused calls."""
        numbers = (line.split()[self.column] for line in _REFUSED.strip().splitlines())
        return [int(number) for number in numbers if number != "-"]


_CLONE3 = 435
_MACHINES = {
    "x86_64": _Machine(0xC000003E, column=1, clone=56, tgkill=234, prlimit=302, set_affinity=203, has_x32=True),
    "aarch64": _Machine(0xC00000B7, column=2, clone=220, tgkill=131, prlimit=261, set_affinity=122, has_x32=False),
}


class _Program(ctypes.Structure):
    """struct sock_fprog."""

    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_void_p))


def refuse_system_calls() -> bool:
    """Install the filter. False where the kernel or the machine has none. Needs no_new_privs to be set."""
    machine = _MACHINES.get(platform.machine())
    if machine is None:
        return False
    code = b"".join(_filter(machine))
    buffer = ctypes.create_string_buffer(code, len(code))
    program = _Program(len(code) // 8, ctypes.cast(buffer, ctypes.c_void_p))
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    return bool(prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(program), 0, 0) == 0)


def _filter(machine: _Machine) -> list[bytes]:
    """The classic BPF program. The two numbers of a jump are how many instructions to skip if true, if false."""
    code = [_op(_LOAD_WORD, _ARCHITECTURE_AT), _op(_JUMP_EQUAL, machine.audit_code, 1, 0), _op(_RETURN, _KILL)]
    code += [_op(_LOAD_WORD, _NUMBER_AT)]
    if machine.has_x32:
        code += [_op(_JUMP_AT_LEAST, _X32_BIT, 0, 1), _op(_RETURN, _KILL)]
    for number in machine.refused:
        code += [_op(_JUMP_EQUAL, number, 0, 1), _op(_RETURN, _ERROR | _EPERM)]
    # The C library falls back from clone3 to clone, whose flags a filter can see: new threads yes, new processes no.
    code += [_op(_JUMP_EQUAL, _CLONE3, 0, 1), _op(_RETURN, _ERROR | _ENOSYS)]
    code += [_op(_JUMP_EQUAL, machine.clone, 0, 4), _op(_LOAD_WORD, _FIRST_ARGUMENT_AT)]
    code += [_op(_JUMP_ANY_BIT, _CLONE_THREAD, 1, 0), _op(_RETURN, _ERROR | _EPERM), _op(_RETURN, _ALLOW)]
    # Done to oneself these are in order: abort() is a signal, torch sets its affinity; 0 is the caller itself.
    for number, itself in ((machine.tgkill, os.getpid()), (machine.prlimit, 0), (machine.set_affinity, 0)):
        code += [_op(_JUMP_EQUAL, number, 0, 4), _op(_LOAD_WORD, _FIRST_ARGUMENT_AT)]
        code += [_op(_JUMP_EQUAL, itself, 1, 0), _op(_RETURN, _ERROR | _EPERM), _op(_RETURN, _ALLOW)]
    code += [_op(_RETURN, _ALLOW)]
    return code


def _op(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    """struct sock_filter."""
    return struct.pack("=HBBI", code, if_true, if_false, value)
