"""The whole gate, child process and all. What the stages refuse in detail is tested beside them, without a process."""

from __future__ import annotations

import ast
import dataclasses
import errno
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import regnf_core
from regnf_core import loading
from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate import gate, report
from regnf_core.importing.gate.gate import FIELD_NAME, ImportLimits, import_field
from regnf_core.importing.gate.report import MIB, OF_THE_FILE
from tests.core.importing.archives import assert_refused, saved, text, torch_zip
from tests.core.importing.checkpoints import write_small_checkpoint
from tests.core.importing.test_reference_checkpoints import SAID
from tests.core.importing.test_safetensors_upload import layout

InChild = Callable[..., report.ImportReport]
ROOT = Path(__file__).resolve().parents[4]
SHORT = ImportLimits(wall_s=100)


@pytest.fixture(scope="module")
def upload(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("upload") / "step-000030000.ckpt"
    write_small_checkpoint(path)
    return path


@pytest.fixture
def in_child(upload: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> InChild:
    """An import whose child runs another program in place of the conversion."""

    def run(program: str, limits: ImportLimits = SHORT) -> report.ImportReport:
        monkeypatch.setattr(gate, "_ENTRY", program)
        return import_field(upload, tmp_path / "out", None, limits)

    return run


def assert_nothing_left(folder: Path) -> None:
    assert list(folder.iterdir()) == []


def test_a_checkpoint_becomes_a_field(upload: Path, tmp_path: Path) -> None:
    """In a folder where another import was refused."""
    out = tmp_path / "fields" / "one"
    assert_refused(lambda: import_field(saved(tmp_path, b"\x89PNG"), out, None, SHORT), "FORMAT_NOT_RECOGNIZED")
    assert_nothing_left(out)
    report = import_field(upload, out, {"label": "ball"} | SAID, SHORT)
    assert [path.name for path in out.iterdir()] == [FIELD_NAME]
    assert report.family == "sdfstudio_neus_facto"
    assert report.label == "ball"
    assert report.bounds == ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert report.field_bytes == (out / FIELD_NAME).stat().st_size
    assert report.parameters == 16 * 256 * 2 + 64 * 71 + 64 + 64 * 64 + 64 + 64 + 1
    assert 10 * MIB < report.peak_memory_bytes < 2048 * MIB
    assert report.plausibility["share_inside"] == pytest.approx(0.065, abs=0.03)
    assert json.loads(json.dumps(report.to_dict()))["family"] == report.family
    field = open_field(out / FIELD_NAME)
    assert field.signed_distance(torch.zeros(1, 3)).item() < 0 < field.signed_distance(torch.ones(1, 3)).item()


def test_a_refused_import_leaves_what_was_there(tmp_path: Path) -> None:
    saved(tmp_path, b"the field of another upload", FIELD_NAME)
    bad = saved(tmp_path, torch_zip()[:-1], "bad")
    assert_refused(lambda: import_field(bad, tmp_path, None, SHORT), "FILE_TRUNCATED")
    assert (tmp_path / FIELD_NAME).read_bytes() == b"the field of another upload"
    assert {path.name for path in tmp_path.iterdir()} == {FIELD_NAME, "bad"}


def test_a_pickle_that_calls_the_shell_calls_nothing(tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    call = b"\x80\x02cposix\nsystem\n" + text(f"touch {canary}") + b"\x85R."
    path = saved(tmp_path, torch_zip(call))
    with pytest.raises(FieldFormatError, match=r"posix\.system") as caught:
        import_field(path, tmp_path / "out", None, SHORT)
    assert caught.value.reason == "UNSAFE_GLOBAL_IN_WEIGHTS"
    assert not canary.exists()


@pytest.mark.parametrize("description", [{"label": object()}, {"label": "x" * 20_000}, {"label": float("nan")}])
def test_descriptions_that_are_no_small_json_are_refused(upload: Path, tmp_path: Path, description: Any) -> None:
    assert_refused(lambda: import_field(upload, tmp_path / "out", description, SHORT), "INVALID_DESCRIPTION")


def test_a_missing_upload_is_the_callers_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        import_field(tmp_path / "none", tmp_path / "out", None, SHORT)


def test_a_late_import_is_ended(upload: Path, tmp_path: Path) -> None:
    words = r"longer than 0\.05 s: stopped after [\d.]+ s and [\d.]+ s of processor"
    with pytest.raises(FieldFormatError, match=words) as caught:
        import_field(upload, tmp_path, None, ImportLimits(wall_s=0.05))
    assert caught.value.reason == "IMPORT_TIMEOUT"
    assert_nothing_left(tmp_path)


def test_a_persons_own_import_has_no_limit_on_time() -> None:
    """Neither by the clock, nor by the processor, nor by an estimate."""
    limits = ImportLimits.of_the_machine()
    assert (limits.longest_s, limits.refused_beyond_s) == (math.inf, math.inf)
    assert ImportLimits(wall_s=9, work_s=5).refused_beyond_s == 5


@pytest.mark.parametrize(("machine", "memory"), [(64 << 30, 64 << 30), (2 << 30, 8 << 30)])
def test_a_persons_own_import_may_have_the_memory_of_the_machine(
    upload: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine: int, memory: int
) -> None:
    asked: list[ImportLimits] = []

    def once(module: str, files: list[Path], out_dir: Path, request: bytes, limits: ImportLimits, *_: object) -> None:
        del module, files, out_dir
        asked.append(limits)
        assert json.loads(request)["limits"]["memory_bytes"] == limits.memory_bytes
        raise FieldFormatError("seen")

    monkeypatch.setattr(report, "memory_of_the_machine", lambda: machine)
    monkeypatch.setattr(gate, "_import_once", once)
    for call in (
        lambda: import_field(upload, tmp_path / "out"),
        lambda: loading.open_field(upload, cache_dir=tmp_path),
    ):
        with pytest.raises(FieldFormatError, match="seen"):
            call()
    (first, second) = asked
    assert first == second
    assert (first.memory_bytes, first.tensor_bytes, first.file_bytes) == (memory, memory // 2, memory // 2)


OF_THE_CIRCUMSTANCES = {"STORAGE_FULL", "IMPORT_CRASHED", "IMPORT_TIMEOUT", "IMPORT_TOO_COSTLY"}
OF_THE_CIRCUMSTANCES |= {"IMPORT_OUT_OF_MEMORY", "IMPORT_OUTPUT_TOO_LARGE"}
"""In which a limit, a setting or the machine's load has a part: tried again, the same upload may be taken."""
WARNED_OF = {"COLOR_ASSUMED", "COLOR_LEFT_OUT"}
FUNCTIONS = {"FUNCTION_UNUSABLE"}
"""Of functions in Python, which no gate sees."""
NO_REASONS = {"COLOR_0", "CESIUM_RTC", "FIELD_NAME", "PXR_WORK_THREAD_LIMIT", "REGNF_NATIVE"}
NO_REASONS |= {f"{library}_NUM_THREADS" for library in ("IGL", "MKL", "OMP", "OPENBLAS")}
"""Words of the same form that name files, attributes and variables of the environment."""


def test_every_reason_is_documented_and_of_the_file_or_of_the_circumstances() -> None:
    """A new reason must be put into one of the two: only those of the file are remembered."""
    root = Path(regnf_core.__file__).parent
    sources = [path for part in ("importing", "schema", "fields") for path in (root / part).rglob("*.py")]
    words = {
        node.value
        for path in sources
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        if re.fullmatch(r"[A-Z][A-Z0-9]*(_[A-Z0-9]+)+", node.value)
    } - NO_REASONS
    assert len(words) > 90
    page = (ROOT / "docs" / "import-gate.md").read_text()
    assert {word for word in words - FUNCTIONS if f"`{word}`" not in page} == set()
    assert words - OF_THE_FILE == OF_THE_CIRCUMSTANCES | WARNED_OF | FUNCTIONS
    assert OF_THE_FILE - words == set()


def test_a_hanging_import_with_closed_streams_is_ended(in_child: InChild) -> None:
    program = "import os, time; os.close(1); os.close(2); time.sleep(600)"
    assert_refused(lambda: in_child(program, ImportLimits(wall_s=0.5)), "IMPORT_TIMEOUT")


def test_endless_computing_is_ended(in_child: InChild) -> None:
    program = "import resource as r; r.setrlimit(r.RLIMIT_CPU, (1, 2))\nwhile True: pass"
    assert_refused(lambda: in_child(program), "IMPORT_TIMEOUT")


def test_too_little_memory_is_told_apart(upload: Path, tmp_path: Path) -> None:
    limits = dataclasses.replace(SHORT, memory_bytes=400 * MIB)
    assert_refused(lambda: import_field(upload, tmp_path, None, limits), "IMPORT_OUT_OF_MEMORY")
    assert_nothing_left(tmp_path)


def test_an_output_beyond_the_limit_is_refused(upload: Path, tmp_path: Path) -> None:
    limits = dataclasses.replace(SHORT, file_bytes=10_000)
    assert_refused(lambda: import_field(upload, tmp_path, SAID, limits), "IMPORT_OUTPUT_TOO_LARGE")
    assert_nothing_left(tmp_path)


BOX = [[0, 0, 0], [1, 1, 1]]
GOOD = {"family": "f", "kind": "k", "why": [], "bounds": BOX, "surface_bounds": BOX, "parameters": 1}
GOOD |= {"plausibility": {}, "warnings": [], "assumed": [], "label": None, "isolation": {}, "peak_memory_bytes": 1}


def claim(**values: Any) -> str:
    """A child that leaves a sound file and says this of it."""
    sound = layout({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, bytes(4))
    return f"open('{FIELD_NAME}', 'wb').write({sound!r}); print({json.dumps(GOOD | values)!r})"


def test_what_a_child_claims_is_taken_when_it_makes_sense(in_child: InChild) -> None:
    """Otherwise the claims below would be refused for another reason."""
    assert in_child(claim()).parameters == 1


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import ctypes; ctypes.string_at(0)", "IMPORT_CRASHED"),
        ("import os; os.abort()", "IMPORT_CRASHED"),
        ("raise SystemExit(3)", "IMPORT_CRASHED"),
        ("", "IMPORT_CRASHED"),
        ("print('hello')", "IMPORT_CRASHED"),
        ("print('[' * 50_000)", "IMPORT_CRASHED"),
        ("while True: print('x' * 1000)", "IMPORT_CRASHED"),
        ('print(\'{"reason": "drop table"}\')', "IMPORT_CRASHED"),
        ("print('{\"reason\": 7}')", "IMPORT_CRASHED"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "IMPORT_OUT_OF_MEMORY"),
        (f"print({json.dumps(GOOD)!r})", "IMPORT_CRASHED"),  # success claimed, no file
        (f"open('{FIELD_NAME}', 'wb').write(b'x' * 100); print({json.dumps(GOOD)!r})", "IMPORT_CRASHED"),
        (f"import os; os.symlink('/etc/passwd', '{FIELD_NAME}'); print({json.dumps(GOOD)!r})", "IMPORT_CRASHED"),
        (f"import os; os.mkdir('{FIELD_NAME}'); print({json.dumps(GOOD)!r})", "IMPORT_CRASHED"),
        ('print(\'{"family": "f"}\')', "IMPORT_CRASHED"),
        (claim(plausibility={"gradient_median": float("nan")}), "IMPORT_CRASHED"),
        (claim(bounds=[[0, 0, 0], [1, 1, float("inf")]]), "IMPORT_CRASHED"),
        (claim(bounds=[[0, 0, 0], [1, 1, 10**400]]), "IMPORT_CRASHED"),
        (claim(parameters=float("inf")), "IMPORT_CRASHED"),
        (claim(isolation=[]), "IMPORT_CRASHED"),
    ],
)
def test_whatever_the_child_does_the_gate_holds(in_child: InChild, tmp_path: Path, program: str, reason: str) -> None:
    assert_refused(lambda: in_child(program), reason)
    assert_nothing_left(tmp_path / "out")


def test_a_child_that_was_killed_from_outside_gets_a_second_try(in_child: InChild, tmp_path: Path) -> None:
    seen = str(tmp_path / "seen")
    killed_once = f"import os; new = not os.path.exists({seen!r}); open({seen!r}, 'w').close()\n"
    assert in_child(f"{killed_once}if new: os.kill(os.getpid(), 9)\n{claim(parameters=7)}").parameters == 7


def test_a_full_disk_is_no_fault_of_the_file(in_child: InChild) -> None:
    with pytest.raises(OSError, match="no space") as caught:
        in_child('print(\'{"reason": "STORAGE_FULL", "detail": "no space"}\')')
    assert caught.value.errno == errno.ENOSPC


def test_the_details_of_a_refusal_are_short_and_printable(in_child: InChild) -> None:
    with pytest.raises(FieldFormatError) as caught:
        in_child("import json; print(json.dumps({'reason': 'SOME_REASON', 'detail': '\\x1b[31m' + 'x' * 9000}))")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 1000


def test_a_kernel_that_grants_no_isolation_is_warned_of() -> None:
    assert [w.split(":")[0] for w in gate._isolation_warnings({"network_namespace": False})] == ["NOT_ISOLATED"]
    assert gate._isolation_warnings({"network_namespace": False, "system_call_filter": True}) == []


def test_the_outer_side_loads_neither_torch_nor_numpy() -> None:
    program = "import sys, regnf_core.importing.gate.gate; sys.exit(bool({'torch', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=False).returncode == 0
