"""How commands end that are cut off, by a signal, a closed pipe or a full disk: silently, leaving nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import DATA
from tests.cli.test_batch import QUICK
from tests.contract.live import eventually

SIGNALED = """
import os, sys

class At:
    "Sends a signal to this process when a module is asked for."

    def find_spec(self, name, path=None, target=None):
        if name == module:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), number)

module, number = sys.argv[1], int(sys.argv[2])
sys.argv = ["regnf", *sys.argv[3:]]
from regnf_cli.main import main
sys.meta_path.insert(0, At())
main()
"""
ROOM, CHAIR, BOX = (str(DATA / name) for name in ("mix-room.safetensors", "armchair.safetensors", "detection.json"))
PAIR = [ROOM, CHAIR, "--detection", BOX]
REGISTER, CONVERT = ["register", *PAIR], ["convert", CHAIR, "a.ply"]
SERVE = ["serve", "--port", "0", "--state-dir", "state"]
CUT_OFF = [
    ("SIGINT", "typer", REGISTER),
    ("SIGTERM", "torch", REGISTER),
    ("SIGHUP", "regnf_cli.supervisor", SERVE),
    ("SIGINT", "httpx", [*REGISTER, "--server", "http://127.0.0.1:9"]),
    ("SIGINT", "regnf_cli.batch", ["batch", BOX]),
    ("SIGINT", "rich.markdown", ["manual", "api"]),
]
ELSEWHERE = [
    *[("SIGINT", name, REGISTER) for name in ("rich", "pydantic", "regnf_cli.report", "numpy", "regnf_cli.register")],
    *[("SIGINT", name, REGISTER) for name in ("torch", "torch._C", "torch.nn", "scipy.spatial", "PIL.Image")],
    ("SIGINT", "regnf_core.library", REGISTER),
    ("SIGTERM", "regnf_core.surface.isosurface", CONVERT),
    ("SIGHUP", "torch", REGISTER),
    *[("SIGINT", name, ["search", *PAIR]) for name in ("regnf_cli.registration", "torch")],
    ("SIGINT", "regnf_core.viewing.artifacts", ["search", *PAIR]),
    *[("SIGINT", name, ["inspect", CHAIR]) for name in ("regnf_cli.inspect", "torch")],
    *[("SIGINT", name, CONVERT) for name in ("igl", "igl.pyigl_core")],
    ("SIGINT", "regnf_core.rendering.job", ["render", ROOM, "--size", "24x18", "--frames", "1"]),
    ("SIGINT", "regnf_cli.doctor", ["doctor"]),
    ("SIGINT", "pydantic_settings", SERVE),
]
"""Every other place where a signal may come; their processes take a minute together."""


def heard() -> None:
    """Below nohup, and in the background of a script, signals are ignored from the start."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def run(arguments: Sequence[str], folder: Path, **how: Any) -> subprocess.CompletedProcess[str]:
    own = {"XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder / "tmp"), "COLUMNS": "120"}
    (folder / "tmp").mkdir(exist_ok=True)
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=os.environ | own, text=True, timeout=100, check=False,
        preexec_fn=heard, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | how,
    )  # fmt: skip


def left(folder: Path) -> list[str]:
    """What lies there beside the caches, with what they have left in the folder for temporary files."""
    there = [one.name for one in folder.iterdir() if one.name not in ("cache", "tmp", "state")]
    return there + [one.name for one in (folder / "tmp").iterdir()]


@pytest.mark.parametrize(
    ("name", "module", "command"),
    [*CUT_OFF, *(pytest.param(*one, marks=pytest.mark.long) for one in ELSEWHERE)],
    ids=[f"{one[2][0]}-{one[1]}-{one[0]}" for one in [*CUT_OFF, *ELSEWHERE]],
)
def test_a_signal_ends_a_command_silently(name: str, module: str, command: list[str], tmp_path: Path) -> None:
    number = signal.Signals[name]
    said = ["--output", "out/below"] if command[0] in ("register", "search", "render") else []
    done = run(["-c", SIGNALED, module, str(int(number)), *command, *said], tmp_path)
    lines = [line for line in done.stderr.splitlines() if line.strip() and "0:00:" not in line]  # the bar's last state
    assert (done.returncode, done.stdout, lines) == (128 + number, "", [])
    assert left(tmp_path) == []


def test_an_interrupted_batch_ends_its_processes_silently(tmp_path: Path) -> None:
    """A terminal sends Ctrl+C to every process of the group."""
    pair = {"scene": ROOM, "object": CHAIR, "detection": BOX, "options": QUICK}
    (tmp_path / "pairs.jsonl").write_text("".join(json.dumps(pair | {"seed": seed}) + "\n" for seed in range(90)))
    results = tmp_path / "pairs.results.jsonl"
    command = [sys.executable, "-m", "regnf_cli.main", "batch", "pairs.jsonl", "--processes", "2"]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=heard,
    ) as running:  # fmt: skip
        eventually(lambda: results.is_file() and results.read_text().count("\n") >= 1, "the first result")
        os.killpg(running.pid, signal.SIGINT)
        stdout, stderr = running.communicate(timeout=60)
    assert (running.returncode, stdout) == (130, "")
    said = [line for line in stderr.splitlines() if line.strip() and "0:00:" not in line and "━" not in line]
    assert said == [
        f"90 pairs, 0 done; results in {results.name}",
        "interrupted: run the same command again to continue",
    ]


FRAME = """
import os, signal, sys, time
sys.argv = ["regnf", "manual", "api"]
from regnf_cli import main as regnf
{run}
regnf._run = run
regnf.main()
"""
FINALIZER = """
class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000): pass
def run():
    Finalized()
    while True: signal.pause()
"""
CLEANING = """
def run():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        while True: pass
    finally:
        time.sleep(3 * regnf._AGAIN_AFTER_S)
        print("cleaned", flush=True)
"""
HELD = """
def run():
    import igl
    sys.kept = igl.winding_number
    sys.modules["kept"] = [igl, sys.kept]
    os.kill(os.getpid(), signal.SIGINT)
    while True: pass
"""


@pytest.mark.parametrize(
    ("program", "printed"),
    [
        pytest.param(FINALIZER, "", id="in a finalizer it is not lost"),
        pytest.param(CLEANING, "cleaned\n", id="it does not interrupt the cleaning"),
        pytest.param(HELD, "", id="compiled libraries do not complain of what is left over"),
    ],
)
def test_an_interrupt_wherever_it_comes(program: str, printed: str, tmp_path: Path) -> None:
    done = run(["-c", FRAME.format(run=program)], tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (130, printed, "")


def some_long(short: list[list[str]], long: list[list[str]]) -> pytest.MarkDecorator:
    marked = [pytest.param(one, marks=pytest.mark.long) for one in long]
    return pytest.mark.parametrize("command", [*short, *marked], ids=" ".join)


@some_long(
    [["register", "--help"], ["manual", "api"], ["--version"]], [["inspect", CHAIR], ["--help"], ["manual"], ["doctor"]]
)
def test_a_closed_pipe_is_no_rejection(command: list[str], tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = run(["-m", "regnf_cli.main", *command], tmp_path, stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


@some_long([["manual", "api"], ["--version"]], [["--help"], ["inspect", CHAIR]])
def test_a_full_output_says_so(command: list[str], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = run(["-m", "regnf_cli.main", *command], tmp_path, stdout=full)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "FILE_UNUSABLE output: No space left on device",
        "hint: Free space on the disk, or give another path.",
    ]


BELOW = ["--output", "new/below"]


@some_long(
    [["convert", CHAIR, "made/chair.ply", "--resolution", "24"]],
    [["render", ROOM, "--size", "64x48", "--frames", "1", *BELOW], [*REGISTER, *BELOW]],
)
def test_a_full_disk_leaves_nothing(command: list[str], tmp_path: Path) -> None:
    """A limit of the size of files stands in for it: the write fails in the same place."""
    (tmp_path / "made").mkdir()
    limited = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500)); sys.argv[0] = 'regnf';"
        "from regnf_cli.main import main; main()"
    )
    done = run(["-c", limited, *command], tmp_path)
    told = [words in done.stderr for words in ("FILE_UNUSABLE", "Free space on the disk", "Traceback")]
    assert (done.returncode, told, left(tmp_path)) == (2, [True, True, False], ["made"]), done.stderr
    assert list((tmp_path / "made").iterdir()) == []
