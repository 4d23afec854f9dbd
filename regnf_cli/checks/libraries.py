"""The libraries: installed, of versions that the package takes, and loadable."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from typing import Literal

from regnf_cli.guard import MODULES
from regnf_core import __version__

# What a check has found.

State = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """subject: what was looked at · state: a warning leaves regnf usable, an error does not · hint: how to mend it."""

    subject: str
    state: State
    found: str
    hint: str | None = None


_REQUIREMENT = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^\]]*\])?\s*([^;]*)(?:;(.*))?$")
_EXTRA = re.compile(r"extra\s*==\s*['\"](\w+)['\"]")
_OPTIONAL = ("rerun",)
"""Extras that one option alone needs: to lack one is no fault."""
_LOADED = ("torch", "open3d", "igl")
"""Those with compiled parts, which may lack a library of the system."""
_LOAD_S = 120
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
        return Finding(extra, "ok", f"not installed, and needed by no other part: {mend}")
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
    for bound in filter(None, wanted.split(",")):
        match = re.match(r"\s*(>=|<=|<|>|==)\s*([\d.]+)", bound)
        if match and not _holds(_numbers(version), match[1], _numbers(match[2])):
            return f"{name} is {version}, expected {wanted}"
    return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version.partition("+")[0])[:3])


def _holds(version: tuple[int, ...], sign: str, bound: tuple[int, ...]) -> bool:
    have, want = version[: len(bound)], bound
    return {
        ">=": have >= want, "<": have < want, "<=": have <= want, ">": have > want, "==": have == want,
    }[sign]  # fmt: skip


def _load(module: str) -> Finding:
    """In a process of its own: a broken library may end it."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, timeout=_LOAD_S, check=False
        )
    except subprocess.TimeoutExpired:
        hint = "Is the disk or the machine very busy? Try again."
        return Finding(module, "warning", f"did not load within {_LOAD_S} s", hint)
    if done.returncode == 0:
        return Finding(module, "ok", "loads")
    last = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
    missing = next((package for library, package in _SYSTEM.items() if library in last), None)
    hint = f"apt-get install {missing}" if missing else f"Install it again: pip install --force-reinstall {module}"
    return Finding(module, "error", last, hint)


# The GPU: whether torch can use one that is there.

_ASK = (
    "import torch; print(torch.cuda.get_device_name(0) if torch.cuda.is_available() else '', torch.version.cuda or '')"
)
_S = 120


def check_gpu() -> Finding:
    """regnf needs none; a GPU that lies idle is a warning."""
    if find_spec("torch") is None:
        return Finding("gpu", "ok", "not looked for: torch is not installed")
    done = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, timeout=_S, check=False)
    name, _, cuda = done.stdout.strip().rpartition(" ") if done.returncode == 0 else ("", "", "")
    if name:
        return Finding("gpu", "ok", f"{name}, CUDA {cuda}")
    if shutil.which("nvidia-smi") is None:
        return Finding("gpu", "ok", "none; everything runs on the processor")
    hint = "Install a torch that is built for your CUDA: pytorch.org has the command. regnf works without it, slower."
    return Finding("gpu", "warning", "there is an NVIDIA driver, but torch cannot use the GPU", hint)


# The native evaluator: whether fields are evaluated by compiled code or with torch.

_SUBJECT = "evaluator"
_SLOWER = "Registrations take 30 to 50 percent longer than with it."
_BUILD = "With a C compiler (apt-get install gcc libc6-dev) it is built when regnf is installed."


def check_native() -> Iterator[Finding]:
    """One finding where the engine is installed. To be without compiled code is no fault."""
    if find_spec("torch") is None:
        return
    from regnf_core.fields.native.library import NOT_BUILT, SWITCH, load

    found = load()
    if os.environ.get(SWITCH) == "0":
        yield Finding(_SUBJECT, "ok", f"torch: compiled code is off, {SWITCH} is 0", _SLOWER)
    elif found.fastest is None:
        hint = f"{_SLOWER} {_BUILD}" if found.fault == NOT_BUILT else _SLOWER
        yield Finding(_SUBJECT, "ok", f"torch: compiled code {found.fault}", hint)
    else:
        yield Finding(_SUBJECT, "ok", f"compiled code, {found.fastest.name}")
