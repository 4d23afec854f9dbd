"""The machine: disk, memory, open files, the port."""

from __future__ import annotations

import resource
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx

from regnf_cli.checks.libraries import Finding
from regnf_state.settings import Settings

_GIB = 1 << 30
_DISK = (2 * _GIB, 10 * _GIB)
_MEMORY = (1 * _GIB, 4 * _GIB)
_FILES = 1024
"""Below the first an error, below the second a warning."""


def check_machine(settings: Settings) -> Iterator[Finding]:
    """What the service needs of the machine."""
    yield _disk(settings.state_dir)
    yield _memory(Path("/proc/meminfo"))
    yield _files(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    yield _port(settings.host, settings.port)


def _disk(folder: Path) -> Finding:
    there = next(place for place in (folder, *folder.parents) if place.exists())
    free = shutil.disk_usage(there).free
    hint = "Make room, or name another folder: --state-dir, REGNF_STATE_DIR."
    return _bounded("disk", free, _DISK, f"{free / _GIB:.1f} GiB free at {there}", hint)


def _memory(meminfo: Path) -> Finding:
    try:
        lines = meminfo.read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return Finding("memory", "ok", "not looked at: the system does not say")
    hint = "A job takes about 1 GiB, with large fields more. Close other programs, or use fewer workers."
    return _bounded("memory", free, _MEMORY, f"{free / _GIB:.1f} GiB available", hint)


def _files(limit: int) -> Finding:
    hint = "Raise it: `ulimit -n 4096`, or LimitNOFILE= of the service's unit."
    if limit == resource.RLIM_INFINITY:
        return Finding("open files", "ok", "no limit")
    return _bounded("open files", limit, (64, _FILES), f"at most {limit}", hint)


def _port(host: str, port: int) -> Finding:
    subject = f"port {port}"
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return _taken(subject, host, port, error)
    return Finding(subject, "ok", f"free on {host}")


def _taken(subject: str, host: str, port: int, error: OSError) -> Finding:
    try:
        answer = httpx.get(f"http://{host}:{port}/version", timeout=5.0)
        if answer.is_success and answer.json().get("name") == "regnf":
            return Finding(subject, "ok", f"regnf serves on {host}:{port}")
    except (httpx.HTTPError, ValueError, AttributeError):
        pass
    hint = "Use another one: regnf serve --port 8081, or REGNF_PORT."
    return Finding(subject, "error", f"cannot be used on {host}: {error.strerror}", hint)


def _bounded(subject: str, value: float, bounds: tuple[int, int], found: str, hint: str) -> Finding:
    if value < bounds[0]:
        return Finding(subject, "error", found, hint)
    return Finding(subject, "warning", found, hint) if value < bounds[1] else Finding(subject, "ok", found)
