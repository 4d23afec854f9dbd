"""The other commands: what they print, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_core import __version__
from regnf_state.settings import Settings
from tests.cli.conftest import DATA, Run

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def test_version_and_help(run: Run) -> None:
    assert run("--version").stdout.strip() == __version__
    assert run("--help").code == 0
    assert run("register", "--help").code == 0
    assert run("unheard-of").code == 2


def test_inspect_shows_a_field(run: Run) -> None:
    outcome = run("inspect", DATA / "armchair.safetensors", "--json")
    assert outcome.code == 0, outcome.stderr
    assert json.loads(outcome.stdout)["parameters"] > 10_000
    assert "plausibility:" in run("inspect", DATA / "armchair.safetensors").stdout


@pytest.mark.parametrize(("content", "reason"), [(b"", "FILE_EMPTY"), (b"\x07" * 4000, "FORMAT_NOT_RECOGNIZED")])
def test_inspect_refuses_what_is_no_field(content: bytes, reason: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "field.ckpt").write_bytes(content)
    outcome = run("inspect", tmp_path / "field.ckpt")
    assert outcome.code == 2
    assert outcome.stderr.startswith(f"{reason} ")
    assert "Traceback" not in outcome.stderr


@pytest.mark.parametrize(
    ("mesh", "output", "more", "reason"),
    [
        (TRIANGLE, "field.txt", [], "INVALID_OPTIONS"),
        (TRIANGLE, "absent/field.safetensors", [], "INVALID_OPTIONS"),
        (TRIANGLE, "field.safetensors", ["--extent", "0"], "INVALID_OPTIONS"),
        (TRIANGLE, "field.safetensors", ["--extent", "-1"], "INVALID_OPTIONS"),
        (TRIANGLE, "field.safetensors", ["--extent", "nan"], "INVALID_OPTIONS"),
        (TRIANGLE, "field.safetensors", ["--label", "x" * 201], "INVALID_OPTIONS"),
        ("f 1 2 3\n", "field.safetensors", [], "MESH_INVALID"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "field.safetensors", [], "MESH_INVALID"),
        ("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "field.safetensors", ["--extent", "1"], "MESH_INVALID"),
    ],
)
def test_fit_refuses(mesh: str, output: str, more: list[str], reason: str, run: Run, tmp_path: Path) -> None:
    (tmp_path / "mesh.obj").write_text(mesh)
    outcome = run("fit", tmp_path / "mesh.obj", tmp_path / output, *more)
    assert outcome.code == 2
    assert f"{reason} " in outcome.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.obj"]


@pytest.mark.parametrize("command", ["serve", "worker"])
@pytest.mark.parametrize(("name", "value"), [("REGNF_PORT", "99999"), ("REGNF_API_TOKENS", "my-secret-token")])
def test_faulty_settings_are_named(
    command: str, name: str, value: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    outcome = run(command)
    assert outcome.code == 2
    assert outcome.stderr.startswith("INVALID_SETTINGS ")
    assert name.removeprefix("REGNF_").lower() in outcome.stderr.lower()
    assert value not in outcome.stderr


def test_a_worker_without_its_redis_is_unavailable(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(settings: Settings) -> None:
        raise RedisConnectionError(f"nobody at {settings.redis_url}")

    monkeypatch.setattr("regnf_worker.main.run_worker", unreachable)
    monkeypatch.setenv("REGNF_REDIS_URL", "")  # restored afterwards: the command sets it
    outcome = run("worker", "--redis-url", "redis://127.0.0.1:9/0")
    assert outcome.code == 3
    assert outcome.stderr.startswith("REDIS_UNAVAILABLE ")


def test_a_fit_says_which_faces_it_turned(run: Run, tmp_path: Path) -> None:
    leg = trimesh.creation.box(bounds=[[-0.2, -0.2, -1.0], [0.2, 0.2, 0.7]])
    leg.invert()
    top = trimesh.creation.box(bounds=[[-1.0, -1.0, 0.8], [1.0, 1.0, 1.0]])
    trimesh.util.concatenate([top, leg]).export(tmp_path / "table.ply")
    outcome = run(
        "fit", tmp_path / "table.ply", tmp_path / "field.safetensors", "--iterations", "1", "--table-log2", "10"
    )
    assert outcome.code == 0, outcome.stderr
    assert "table.ply: " in outcome.stderr
    assert "turned round" in outcome.stderr
