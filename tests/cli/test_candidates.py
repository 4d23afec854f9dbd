"""A file that may be one of several functions: the commands say what to add for each, and draw them on demand."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from regnf_core.errors import Candidate, FieldFormatError
from regnf_core.importing.gate import gate
from tests.cli.conftest import DATA, Run, Serve, field
from tests.core.importing.gate.test_candidates import two_scales

ASKED = (Candidate("it's smooth", {"hash": {"interpolation": "smoothstep"}}, b"png"), Candidate("b", {"sign": -1}))


@pytest.fixture
def asking(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gate asks about every file."""

    def ask(*_: Any, **__: Any) -> None:
        raise FieldFormatError("which?", reason="LAYOUT_AMBIGUOUS", candidates=ASKED)

    monkeypatch.setattr(gate, "import_field", ask)


def lines_of(stderr: str, option: str) -> list[Any]:
    """The descriptions that may be pasted."""
    found = [shlex.split(line) for line in stderr.splitlines() if line.strip().startswith(option)]
    assert all(name == option for name, _ in found)
    return [json.loads(text) for _, text in found]


@pytest.mark.usefixtures("asking")
def test_each_line_can_be_pasted(run: Run, tmp_path: Path) -> None:
    """Together with what was said before."""
    (tmp_path / "a.ckpt").write_bytes(b"PK\x03\x04")
    outcome = run("inspect", tmp_path / "a.ckpt", "--description", '{"hash": {"levels": 8}, "label": "chair\'s"}')
    assert (outcome.code, outcome.stdout) == (2, "")
    assert outcome.stderr.startswith(f"LAYOUT_AMBIGUOUS {tmp_path / 'a.ckpt'}: which?\n")
    assert "hint: " in outcome.stderr
    assert "1  it's smooth\n" in outcome.stderr
    said = {"hash": {"levels": 8}, "label": "chair's"}
    smooth = {"hash": {"levels": 8, "interpolation": "smoothstep"}, "label": "chair's"}
    assert lines_of(outcome.stderr, "--description") == [smooth, said | {"sign": -1}]
    outcome = run("convert", tmp_path / "a.ckpt", tmp_path / "a.safetensors")
    assert lines_of(outcome.stderr, "--description") == [dict(one.description) for one in ASKED]
    outcome = run("inspect", tmp_path / "a.ckpt", "--candidates", tmp_path / "absent" / "new")
    assert (outcome.code, outcome.stderr.partition(" ")[0]) == (2, "INVALID_OPTIONS")
    assert "mkdir -p" in outcome.stderr


@pytest.mark.usefixtures("asking")
@pytest.mark.parametrize("use", ["scene", "object"])
def test_a_registration_names_the_option_of_the_field(use: str, run: Run, tmp_path: Path) -> None:
    fields = {"scene": DATA / "mix-room.safetensors", "object": DATA / "armchair.safetensors"}
    fields[use] = tmp_path / "a.ckpt"
    fields[use].write_bytes(b"PK\x03\x04")
    outcome = run("register", *fields.values(), "--detection", DATA / "detection.json", code=2)
    assert len(lines_of(outcome.stderr, f"--{use}-description")) == 2


def test_a_line_and_a_picture_of_a_real_file(run: Run, tmp_path: Path) -> None:
    upload = two_scales(tmp_path)
    outcome = run("inspect", upload, "--candidates", tmp_path / "new", "--description", '{"label": "pot"}', code=2)
    assert f"LAYOUT_AMBIGUOUS {upload}: " in outcome.stderr
    assert f"wrote {tmp_path / 'new' / '1.png'}\n" in outcome.stderr
    lines = lines_of(outcome.stderr, "--description")
    (number,) = (number for number, line in enumerate(lines, 1) if line["input_scale"] == 1.0)
    with Image.open(tmp_path / "new" / f"{number}.png") as picture:
        assert picture.size == (576, 192)
    assert run("inspect", upload, "--description", json.dumps(lines[number - 1])).code == 0


def test_a_service_asks_as_well(run: Run, serve: Serve, tmp_path: Path) -> None:
    (tmp_path / "a.ckpt").write_bytes(b"PK\x03\x04")
    error = {
        "reason": "LAYOUT_AMBIGUOUS",
        "detail": "which?",
        "candidates": [{"name": "one", "description": {"sign": 1}, "picture": None}, {"name": 3}, "odd"],
    }

    seen: list[str] = []

    def answer(method: str, path: str) -> tuple[int, str]:
        seen.append(method)
        if seen == ["GET"]:
            return 404, json.dumps({"reason": "FIELD_NOT_FOUND"})
        return 200, field(path, state="rejected", error=error)

    fields = (tmp_path / "a.ckpt", DATA / "armchair.safetensors")
    said = ("--scene-description", '{"label": "room"}')
    outcome = run("register", *fields, "--detection", DATA / "detection.json", *said, "--server", serve(answer), code=2)
    assert f"LAYOUT_AMBIGUOUS {tmp_path / 'a.ckpt'}: which?" in outcome.stderr
    assert lines_of(outcome.stderr, "--scene-description") == [{"label": "room", "sign": 1}]
