"""Results in the blob store: a job has one."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from regnf_state.manifest import Artifact, Manifest, read_manifest
from regnf_worker.artifacts import discard_others, publish, store_artifacts, told_by_result
from tests.stores import HeldBlobs


def test_a_manifest_says_what_lies_where(tmp_path: Path) -> None:
    blobs = HeldBlobs(tmp_path / "blobs")
    (tmp_path / "result.json").write_bytes(b"{}")
    (tmp_path / "trace.unknown").write_bytes(b"xyz")
    stored = store_artifacts(blobs, "j1", 3, tmp_path, ["result.json", "trace.unknown"])
    manifest = Manifest("j1", 3, stored)
    assert read_manifest(blobs, "j1") is None, "stored is not yet published"
    assert publish(blobs, manifest)
    assert read_manifest(blobs, "j1") == manifest
    assert manifest.attempt == 3
    assert manifest.artifacts[1] == Artifact("trace.unknown", 3, hashlib.sha256(b"xyz").hexdigest())
    assert manifest.artifacts[1].media_type == "application/octet-stream"
    assert list(manifest.served()) == ["result.json"]


def test_a_job_has_one_result(tmp_path: Path) -> None:
    blobs = HeldBlobs(tmp_path)
    first = Manifest("j1", 1, (Artifact("x", 1, "0"),))
    assert publish(blobs, first)
    assert not publish(blobs, Manifest("j1", 2, ()))
    assert read_manifest(blobs, "j1") == first
    for key in ("jobs/j1/1/x", "jobs/j1/1/old", "jobs/j1/2/x", "jobs/j10/2/x"):
        blobs.put(key, b".")
    discard_others(blobs, first)
    assert sorted(blobs.blobs) == ["jobs/j1/1/x", "jobs/j1/manifest.json", "jobs/j10/2/x"]


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (
            {"verdict": "registered", "probability": 0.95, "level": "default", "object": "a1"},
            {"verdict": "registered", "probability": 0.95, "level": "default", "object_found": None},
        ),
        (
            {
                "verdict": "rejected",
                "probability": 0.5,
                "level": None,
                "object": "a1",
                "candidates": [{"object": "a1"}],
            },
            {"verdict": "rejected", "probability": 0.5, "level": None, "object_found": "a1"},
        ),
        (
            {"verdict": "?", "probability": "?", "level": "?", "object": 3, "candidates": [{}]},
            {"verdict": None, "probability": None, "level": None, "object_found": None},
        ),
        ([], {}),
    ],
)
def test_a_record_says_the_verdict_and_which_object_a_search_has_found(
    tmp_path: Path, result: Any, told: dict[str, Any]
) -> None:
    blobs = HeldBlobs(tmp_path)
    manifest = Manifest("j1", 1, (Artifact("result.json", 1, "0"),))
    blobs.put(manifest.key("result.json"), json.dumps(result).encode())
    assert told_by_result(blobs, manifest) == told
