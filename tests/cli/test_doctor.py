"""`regnf doctor` names what is wrong, says how to mend it, and finds nothing wrong where nothing is."""

from __future__ import annotations

import json
import socket
from functools import partial
from pathlib import Path

import pytest

from regnf_cli import doctor
from regnf_cli.doctor import Finding
from regnf_core.native import library
from regnf_state.settings import Settings
from tests.cli.conftest import Run


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No library is loaded, and nothing of this machine's own state is looked at."""
    monkeypatch.setattr(doctor, "_LOADED", ())
    monkeypatch.setattr("regnf_cli.doctor.check_gpu", lambda: Finding("gpu", "ok", "none"))
    monkeypatch.setenv("REGNF_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("REGNF_PORT", "0")
    monkeypatch.delenv("REGNF_REDIS_URL", raising=False)


def findings_of(run: Run) -> tuple[int, dict[str, dict[str, str]]]:
    done = run("doctor", "--json")
    return done.code, {one["subject"]: one for one in json.loads(done.stdout)}


def test_a_whole_installation(quick: None, run: Run) -> None:
    code, found = findings_of(run)
    assert {one["state"] for name, one in found.items() if name not in ("disk", "memory")} == {"ok"}, found
    assert {"python", "engine", "service", "redis", "storage", "disk", "memory", "open files", "port 0"} <= set(found)
    assert code in (0, 3)  # a machine may be short of memory


@pytest.mark.parametrize(
    ("name", "value", "subject", "said"),
    [
        ("REGNF_REDIS_URL", "redis://:secret@127.0.0.1:1/0", "redis", "Start it"),
        ("REGNF_PORT", "eighty", "settings", "REGNF_PORT"),
    ],
)
def test_a_redis_that_does_not_answer_and_a_faulty_setting(
    quick: None, run: Run, monkeypatch: pytest.MonkeyPatch, name: str, value: str, subject: str, said: str
) -> None:
    monkeypatch.setenv(name, value)
    code, found = findings_of(run)
    assert (code, found[subject]["state"], name in str(found[subject])) == (3, "error", True)
    told = run("doctor").stdout
    assert f"{subject}: " in told
    assert said in told
    assert "secret" not in str(found) + told


def test_how_fields_are_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    load = library.load
    monkeypatch.delenv(library.SWITCH, raising=False)
    for path, said in ((Path("none.so"), "compiled code was not built"), (library.LIBRARY, "compiled code")):
        monkeypatch.setattr(library, "load", partial(load, path))
        (found,) = doctor.check_native()
        assert (found.state, said in found.found) == ("ok", True)
    monkeypatch.setenv(library.SWITCH, "0")
    (found,) = doctor.check_native()
    assert found.found == "torch: compiled code is off, REGNF_NATIVE is 0"


def test_a_port_that_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        taken.close()
        assert doctor._port("127.0.0.1", port).state == "ok"
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))  # nobody listens, so nothing answers either
        found = doctor._port("127.0.0.1", bound.getsockname()[1])
    assert found.state == "error"
    assert "--port" in str(found.hint)


def test_too_little_of_something_and_a_storage_that_cannot_be_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    found = list(doctor.check_service(Settings(state_dir=tmp_path / "file" / "state")))[1]
    assert (found.subject, found.state) == ("storage", "error")
    assert "REGNF_STATE_DIR" in str(found.hint)
    meminfo = tmp_path / "meminfo"
    for kib, state in ((500_000, "error"), (2_000_000, "warning"), (9_000_000, "ok")):
        meminfo.write_text(f"MemTotal: 1 kB\nMemAvailable: {kib} kB\n")
        assert doctor._memory(meminfo).state == state
    assert [doctor._files(limit).state for limit in (20, 256, 65536)] == ["error", "warning", "ok"]


def test_versions_and_missing_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._fault("numpy", ">=1.26") is None
    assert "expected <1.0" in str(doctor._fault("numpy", "<1.0"))
    assert doctor._fault("no-such-package", "") == "no-such-package not installed"
    monkeypatch.setattr(doctor, "_requirements", lambda extra: [(f"no-{extra}", ">=1")])
    found = {extra: doctor._extra(extra) for extra in ("rerun", "embedded")}
    assert {extra: one.state for extra, one in found.items()} == {"rerun": "ok", "embedded": "warning"}
    assert "pip install 'regnf[rerun]'" in found["rerun"].found


def test_a_library_that_does_not_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = doctor._load("broken")
    assert (found.state, found.hint) == ("error", "apt-get install libgl1")
