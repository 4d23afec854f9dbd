"""Results in the blob store: a job has one."""

import hashlib
from pathlib import Path

from regnf_state.memory import InMemoryBlobStore
from regnf_worker.artifacts import discard_others, publish, read_manifest, store_artifacts


def test_a_manifest_says_what_lies_where(tmp_path: Path) -> None:
    blobs = InMemoryBlobStore()
    (tmp_path / "result.json").write_bytes(b"{}")
    (tmp_path / "trace.unknown").write_bytes(b"xyz")
    manifest = store_artifacts(blobs, "j1", 3, tmp_path, ["result.json", "trace.unknown"])
    assert read_manifest(blobs, "j1") is None, "stored is not yet published"
    assert publish(blobs, "j1", manifest)
    assert read_manifest(blobs, "j1") == manifest
    assert manifest["attempt"] == 3
    assert manifest["artifacts"][1] == {
        "name": "trace.unknown",
        "bytes": 3,
        "media_type": "application/octet-stream",
        "sha256": hashlib.sha256(b"xyz").hexdigest(),
    }


def test_a_job_has_one_result() -> None:
    blobs = InMemoryBlobStore()
    first = {"attempt": 1, "artifacts": [{"name": "x"}]}
    assert publish(blobs, "j1", first)
    assert not publish(blobs, "j1", {"attempt": 2, "artifacts": []})
    assert read_manifest(blobs, "j1") == first
    for key in ("jobs/j1/1/x", "jobs/j1/1/old", "jobs/j1/2/x", "jobs/j10/2/x"):
        blobs.put(key, b".")
    discard_others(blobs, "j1", first)
    assert sorted(blobs.blobs) == ["jobs/j1/1/x", "jobs/j1/manifest.json", "jobs/j10/2/x"]
