"""``regnf render`` and ``regnf edit``: files, and requests that are refused before any work."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from regnf_cli.commands import app_of
from regnf_core.editing.storing import write_field
from regnf_core.errors import RegnfError
from tests.contract.live import DEADLINE_S, eventually
from tests.core.analytic import boxes, sphere
from tests.listing import below

T = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.25], [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture(scope="module")
def fields(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fields")
    bounds = [[-1.0, -1.0, -0.1], [1.0, 1.0, 1.0]]
    write_field(boxes([([-1.0, -1.0, -0.1], [1.0, 1.0, 0.0])], bounds), folder / "room.safetensors", 24)
    write_field(sphere(0.25, bounds=[[-0.4] * 3, [0.4] * 3]), folder / "ball.safetensors", 24)
    return folder


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app_of(), list(arguments))


def test_an_edit_names_its_files_from_its_own_folder(fields: Path, tmp_path: Path) -> None:
    (fields / "result.json").write_text(json.dumps({"T_object_scene": {"matrix": T}}))
    edits = [{"kind": "insertion", "object": "ball.safetensors", "T_object_scene": "result.json"}]
    (fields / "edits.json").write_text(json.dumps(edits))
    size = ("--size", "24x18", "--frames", "1", "--outputs", "color,strip", "--output", str(tmp_path / "out"))
    done = run("edit", str(fields / "room.safetensors"), "--edits", str(fields / "edits.json"), *size)
    assert done.exit_code == 0, done.output
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"frame-0000.png", "before-0000.png", "before-after.png", "render.json"}


def test_a_command_that_is_terminated_leaves_nothing_behind(fields: Path, tmp_path: Path) -> None:
    """SIGTERM is what schedulers and service managers send."""
    output = tmp_path / "out"
    size = ["--mode", "volume", "--size", "192x144", "--frames", "500"]
    said = ["render", str(fields / "room.safetensors"), *size, "--output", str(output)]
    with subprocess.Popen([sys.executable, "-m", "regnf_cli.main", *said], stderr=subprocess.PIPE) as command:
        eventually(lambda: output.is_dir() and any(path.suffix == ".png" for path in below(output)), "the first frame")
        command.terminate()
        _, errors = command.communicate(timeout=DEADLINE_S)
    assert (command.returncode, output.exists()) == (143, False)
    assert b"Traceback" not in errors


def test_cameras_of_a_file(fields: Path, tmp_path: Path) -> None:
    pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.8], [0.0, 1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]  # OpenGL's axes
    cameras = {"fl_x": 20.0, "fl_y": 20.0, "cx": 12.0, "cy": 9.0, "w": 24, "h": 18}
    (tmp_path / "transforms.json").write_text(json.dumps(cameras | {"frames": [{"transform_matrix": pose}] * 3}))
    said = ("--cameras", str(tmp_path / "transforms.json"), "--every", "2", "--size", "24x18", "--outputs", "depth")
    done = run("render", str(fields / "room.safetensors"), *said, "--output", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    assert len(list((tmp_path / "out").glob("*.npy"))) == 2


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("INVALID_OPTIONS", ("--size", "wide")),
        ("RENDER_TOO_LARGE", ("--size", "100000x10000")),
        ("INVALID_OPTIONS", ("--outputs", "film")),
        ("CAMERA_INVALID", ("--up-axis", "w")),
    ],
)
def test_bad_options_have_reasons(fields: Path, tmp_path: Path, reason: str, said: tuple[str, ...]) -> None:
    done = run("render", str(fields / "room.safetensors"), *said, "--output", str(tmp_path / "out"))
    assert isinstance(done.exception, RegnfError)
    assert done.exception.reason == reason
    assert not (tmp_path / "out").exists()
