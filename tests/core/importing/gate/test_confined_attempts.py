"""What a confined child tries in vain, and an unconfined one does not: otherwise the tests would prove nothing."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from regnf_core.importing.gate import gate
from regnf_core.importing.gate.child import run_child
from tests.core.importing.attempts import BY_LAYER, NOT_EVERYWHERE

pytestmark = pytest.mark.skipif(
    platform.machine() != "x86_64" or sys.platform != "linux", reason="the attempts name x86-64 Linux's system calls"
)
ROOT = Path(__file__).resolve().parents[4]
SECRET = b"hunter2!"
REFUSED = {"EPERM", "EACCES", "EXDEV", "ENOSYS"}
"""Landlock answers a move or a link from one place to another with EXDEV; the filter, what it does not list with
ENOSYS."""
PROGRAM = f"""
import ctypes, json, os, sys
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from regnf_core.importing.gate import sandbox
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.attempts import run_all
where = json.load(sys.stdin)
upload, home = os.open(where["upload"], os.O_RDONLY), Path(where["home"])
granted = {{}}
if where["layer"] == "everything":
    granted = sandbox.confine(ImportLimits(), where["parent"], [upload], home)
elif where["layer"] != "nothing":
    assert ctypes.CDLL(None).prctl(38, 1, 0, 0, 0) == 0
    if where["layer"] == "filter":
        granted = {{"filter": sandbox.refuse_system_calls()}}
    else:
        granted = {{"landlock": sandbox.restrict_files([upload, *sandbox._readable()], home)}}
print(json.dumps([granted, run_all(where)]))
"""
Results = tuple[dict[str, bool], dict[str, str]]


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """A store with a secret in it, sockets that listen, and a secret in this process's memory."""
    top = tmp_path_factory.mktemp("attempts")
    for name in ("store", "home"):
        (top / name).mkdir()
    for name in ("store/secret", "upload"):
        (top / name).write_bytes(SECRET)
    memory = ctypes.create_string_buffer(SECRET)
    abstract = f"\0regnf-{os.getpid()}"
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        for address in (str(top / "socket"), abstract):
            local = stack.enter_context(socket.socket(socket.AF_UNIX))
            local.bind(address)
            local.listen()
        yield {
            "port": server.getsockname()[1],
            "unix": str(top / "socket"),
            "abstract": abstract,
            "parent": os.getpid(),
            "secret_at": ctypes.addressof(memory),
            "store": str(top / "store"),
            "secret": str(top / "store" / "secret"),
            "upload": str(top / "upload"),
            "home": str(top / "home"),
        }


def try_under(layer: str, where: dict[str, Any]) -> Results:
    """What the kernel granted, and how each attempt ended."""
    request = json.dumps(where | {"layer": layer}).encode()
    command = [sys.executable, "-I", "-B", "-c", PROGRAM]
    outcome = run_child(command, request, Path(where["home"]), gate._environment(), 60)
    assert outcome.exit_status == 0, outcome
    granted, results = json.loads(outcome.stdout)
    return granted, results


@pytest.fixture(scope="module")
def ended(where: dict[str, Any]) -> dict[str, Results]:
    """The results under each layer."""
    return {layer: try_under(layer, where) for layer in ("nothing", *BY_LAYER)}


def names(layer: str) -> list[str]:
    return sorted(BY_LAYER[layer])


@pytest.mark.parametrize("name", names("everything"))
def test_without_confinement_the_attempt_succeeds(ended: dict[str, Results], name: str) -> None:
    result = ended["nothing"][1][name]
    if name in NOT_EVERYWHERE and result != "done":
        pytest.skip(f"this system forbids it anyway: {result}")
    assert result == "done"


@pytest.mark.parametrize(("layer", "name"), [(layer, name) for layer in BY_LAYER for name in names(layer)])
def test_a_confined_attempt_is_refused(ended: dict[str, Results], layer: str, name: str) -> None:
    granted, results = ended[layer]
    wanted = ["files_restricted", "system_call_filter"] if layer == "everything" else [layer]
    if missing := [confinement for confinement in wanted if not granted[confinement]]:
        pytest.skip(f"this kernel does not grant: {missing}")
    assert results[name] in REFUSED


def test_nothing_was_harmed(ended: dict[str, Results], where: dict[str, Any]) -> None:
    assert Path(where["secret"]).read_bytes() == SECRET
    assert os.listdir(where["store"]) == ["secret"]
    assert os.listdir(where["home"]) == []
