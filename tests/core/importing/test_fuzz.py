"""Whatever the bytes: success or FieldFormatError, never another exception."""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.legacy_container import TorchArchive, read_archive
from regnf_core.importing.containers.safetensors_header import read_header
from regnf_core.importing.containers.sniff import explain_refusal, sniff_format
from regnf_core.importing.families import convert_checkpoint
from regnf_core.importing.pickle.pickle_machine import PickleLimits
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import torch_zip
from tests.core.importing.checkpoints import checkpoint
from tests.core.importing.fuzzing.cases import STAGES, make_case
from tests.core.importing.fuzzing.seeds import Seeds, make_seeds
from tests.core.importing.fuzzing.stages import run_stage
from tests.core.importing.fuzzing.worker import ENVIRONMENT

ROOT = Path(__file__).resolve().parents[3]
CASES = 4_500

LIMITS = PickleLimits(opcodes=20_000)
quick = settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)

Edit = tuple[int, int, bytes]
edits = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 12), st.binary(max_size=12)), min_size=1, max_size=4)
"""Where (modulo the length), how many bytes go, and what comes in their place."""

opcodes = st.one_of(
    st.integers(0, 255).map(lambda value: bytes([value])),
    st.sampled_from(
        [
            *(bytes([c]) for c in b"(.]})NRbQtause0\x81\x85\x86\x87\x88\x89\x93\x94"),
            *(b"q\x00", b"h\x00", b"K\x03", b"J\xff\xff\xff\xff", b"X\x07\x00\x00\x00storage", b"X\x01\x00\x00\x000"),
            *(b"ctorch\nFloatStorage\n", b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n"),
            *(
                b"cnumpy\ndtype\n",
                b"cnumpy.core.multiarray\nscalar\n",
                b"c_codecs\nencode\n",
                b"X\x06\x00\x00\x00latin1",
            ),
            *(b"c__builtin__\nset\n", b"ccopy_reg\n_reconstructor\n", b"cos\nsystem\n", b"X\x03\x00\x00\x00cpu"),
        ]
    ),
)


@cache
def sound_archive() -> bytes:
    buffer = io.BytesIO()
    torch.save(checkpoint(log2_size=8, hidden=8, optimizer=False), buffer)
    return buffer.getvalue()


@cache
def sound_parts() -> tuple[TorchArchive, bytes]:
    archive = read_archive(memoryview(sound_archive()))
    return archive, bytes(archive.read("data.pkl"))


def edited(data: bytes, changes: list[Edit]) -> bytes:
    for where, gone, come in changes:
        at = where % (len(data) + 1)
        data = data[:at] + come + data[at + gone :]
    return data


def take(archive: TorchArchive, pickle: bytes) -> None:
    """The stages from the pickle to the converted field."""
    source = TensorSource(archive, 1 << 24)
    convert_checkpoint(read_pickle(memoryview(pickle), LIMITS), source, UploadDescription())


def take_file(data: bytes) -> None:
    """The stages from the container to the converted field, with every entry read."""
    archive = read_archive(memoryview(data))
    for name in archive.entries:
        archive.read(name)
    take(archive, bytes(archive.read("data.pkl")))


def holds(action: Callable[[], object]) -> bool:
    """Whether the action succeeds or is refused with a reason; any other exception passes through."""
    try:
        action()
    except FieldFormatError as error:
        return error.reason.isupper()
    return True


@quick
@given(edits)
def test_a_damaged_archive(changes: list[Edit]) -> None:
    assert holds(lambda: take_file(edited(sound_archive(), changes)))


@quick
@given(st.lists(st.tuples(st.integers(0, 700), st.just(2), st.binary(min_size=2, max_size=2)), min_size=1, max_size=3))
def test_damaged_records_at_the_archives_end(changes: list[Edit]) -> None:
    """The directory's records lie there; edits keep the length, so that most of them reach the deeper checks."""
    head, tail = sound_archive()[:-700], sound_archive()[-700:]
    assert holds(lambda: take_file(head + edited(tail, changes)[:700].ljust(700, b"\0")))


@quick
@given(edits)
def test_a_damaged_pickle(changes: list[Edit]) -> None:
    archive, pickle = sound_parts()
    assert holds(lambda: take(archive, edited(pickle, changes)))


@quick
@given(st.lists(opcodes, max_size=60))
def test_any_sequence_of_opcodes(codes: list[bytes]) -> None:
    archive, _ = sound_parts()
    assert holds(lambda: take(archive, b"\x80\x02" + b"".join(codes) + b"."))


@quick
@given(st.lists(opcodes, max_size=40))
def test_any_value_in_place_of_a_needed_tensor(codes: list[bytes]) -> None:
    name = b"_model.field.glin0.bias"
    key = b"X" + struct.pack("<I", len(name)) + name
    pickle = b"\x80\x02}X\x08\x00\x00\x00pipeline}" + key + b"".join(codes) + b"ss."
    archive = read_archive(memoryview(torch_zip(storages={"0": bytes(12)})))
    assert holds(lambda: take(archive, pickle))


@quick
@given(st.binary(max_size=200), st.booleans())
def test_any_safetensors_header(body: bytes, length_fits: bool) -> None:
    data = (len(body).to_bytes(8, "little") if length_fits else b"") + body
    assert holds(lambda: read_header(memoryview(data)))


@quick
@given(st.binary(max_size=600))
def test_any_head_is_named_or_explained(head: bytes) -> None:
    assert sniff_format(head) is not None or explain_refusal(head)[0].isupper()


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    return make_seeds(tmp_path_factory.mktemp("seeds"))


@pytest.fixture(scope="module")
def fuzzed(seeds: Seeds, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the fuzzing process makes of the cases that `python -m benchmarks.fuzz_gate` begins with."""
    folder = tmp_path_factory.mktemp("fuzz")
    seeds.save(folder / "seeds")
    module, places = "tests.core.importing.fuzzing.worker", (str(folder / "seeds"), str(folder))
    command = [sys.executable, "-m", module, *places, "1.1", str(folder / "corpus"), *STAGES]
    asked, environment = f"0 {CASES}\n", os.environ | ENVIRONMENT
    done = subprocess.run(command, input=asked, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stderr} at {(folder / 'case').read_bytes()!r:.300}"
    results: dict[str, Any] = json.loads(done.stdout)
    return results


@pytest.mark.long
@pytest.mark.timeout(900)
def test_no_invented_file_is_more_than_refused(fuzzed: dict[str, Any]) -> None:
    """No other exception, no import, no file left or opened, nothing slow, nothing large."""
    assert [(failure["at"], failure["fault"]) for failure in fuzzed["failures"]] == []
    assert sum(fuzzed["outcomes"].values()) == CASES


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_fuzzer_reaches_what_lies_deep(fuzzed: dict[str, Any]) -> None:
    """A fuzzer whose cases all fail at the first check would find nothing."""
    outcomes = fuzzed["outcomes"]
    assert all(outcomes[f"{stage} taken"] > 10 for stage in STAGES)
    deep = ("ARCHIVE_CRC_MISMATCH", "TENSOR_NOT_DENSE", "TENSOR_NOT_FINITE", "TENSOR_STORAGE_MISMATCH", "TENSOR_SHAPE")
    assert all(any(key.endswith(reason) for key in outcomes) for reason in deep)
    assert len({key.split()[1] for key in outcomes}) > 40
    assert fuzzed["finds"] > 50


def test_every_sound_file_is_taken(seeds: Seeds, tmp_path: Path) -> None:
    """What is refused undamaged would never get deeper damaged."""
    files = {"checkpoint": seeds.archive, "field file": seeds.field_file, **seeds.other_files}
    ended = {
        kind: run_stage("settings" if kind.startswith("settings ") else "file", data, tmp_path)
        for kind, data in files.items()
    }
    assert ended == dict.fromkeys(files, "taken")


@pytest.mark.parametrize("stage", STAGES)
def test_a_seed_gives_the_same_cases_again(seeds: Seeds, stage: str) -> None:
    first, second = ([make_case(Random(i), stage, seeds, []) for i in range(50)] for _ in range(2))
    assert first == second
    assert len(set(first)) > 30


WATCHED = """
import sys
from tests.core.importing.fuzzing.stages import Watch
watch = Watch()
with watch.over("pickle"):
    {action}
print("heard" if watch.events else "silent")
"""


@pytest.mark.parametrize(
    ("action", "heard"),
    [
        ("import this_is_no_module_of_ours", "heard"),
        ("__import__('os').system('true')", "heard"),
        ("open('/dev/null')", "heard"),
        ("eval('1')", "heard"),
        ("__import__('socket').socket()", "heard"),
        ("sorted([3, 1, 2])", "silent"),
    ],
)
def test_the_watch_hears_what_a_file_must_not_bring_about(action: str, heard: str) -> None:
    action = f"try: {action}\n    except ImportError: pass"
    program = WATCHED.format(action=action)
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == heard, done.stderr
