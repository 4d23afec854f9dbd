"""A folder as a new user has it: a room, a chair, a box, a training run, and files that are no fields."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.conftest import DATA, demo, run, serve
from tests.contract.conftest import world, worlds

__all__ = ["demo", "folder", "run", "serve", "world", "worlds"]
BOX = {"center": [-0.56, -0.28, -0.24], "size": [0.55, 0.6, 0.51]}


@pytest.fixture(autouse=True)
def quick_and_clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that would serve for hours set up the process' log, and wait for a Redis that is not there."""
    for module in ("regnf_state.logs", "regnf_worker.main"):
        monkeypatch.setattr(f"{module}.configure_logging", lambda _: None)
    monkeypatch.setattr("redis.backoff.ExponentialWithJitterBackoff.compute", lambda *_: 0.0)
    monkeypatch.setenv("REGNF_PRELOAD", "false")  # a worker may begin its program anew: here that is the test runner


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Made the current folder."""
    (tmp_path / "room.safetensors").symlink_to(DATA / "mix-room.safetensors")
    (tmp_path / "chair.safetensors").symlink_to(DATA / "armchair.safetensors")
    (tmp_path / "box.json").write_text(json.dumps(BOX))
    models = tmp_path / "run" / "sdfstudio_models"
    models.mkdir(parents=True)
    (tmp_path / "run" / "config.yml").write_text("method: neus-facto\n")
    for step in ("000010000", "000030000"):
        (models / f"step-{step}.ckpt").write_bytes(b"PK\x03\x04")
    (tmp_path / "nothing").mkdir()
    monkeypatch.chdir(tmp_path)
    for name in ("REGNF_API_TOKEN", "REGNF_API_TOKENS", "REGNF_REDIS_URL"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path
