"""A service and the work of its import, in one process: from the bytes of an upload to what the field becomes."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from redis import Redis

from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import MIB, ImportLimits
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from tests.contract.world import World, assert_refused, make_world, sha256

LIMITS = ImportLimits(tensor_bytes=64 * MIB)


def convert(
    upload: Path, folder: Path, description: dict[str, Any], settings: Path | None, cameras: Path | None = None
) -> dict[str, Any]:
    """What the gate's process does, without a process of its own: the gate's own tests cover that."""
    return convert_file(upload, folder, description or None, LIMITS)


@dataclass(repr=False)
class House:
    """The service's world, a worker's context over the same stores, and the folder for temporary files."""

    world: World
    context: Context
    scratch: Path
    good: bytes
    """A field file that is taken."""

    def outcome(self, data: bytes) -> str:
        """What becomes of an upload: "status REASON" if it is refused at once, "rejected REASON", or "ready"."""
        answer = self.world.client.post("/fields", content=data)
        if answer.status_code >= 400:
            assert_refused(answer, answer.status_code, answer.json()["reason"])
            return f"{answer.status_code} {answer.json()['reason']}"
        return self.imported(answer)

    def imported(self, answer: httpx.Response) -> str:
        """What the worker makes of an upload that was stored."""
        sha, attempt = self.world.queue.imports[-1]
        run_import_attempt(self.context, sha, attempt, "w", convert)
        field = self.world.client.get(answer.json()["links"]["self"]).json()
        return field["state"] if field["state"] == "ready" else f"{field['state']} {field['error']['reason']}"

    def assert_nothing_left(self) -> None:
        """No blob and no temporary file; of a record at most the word that, and why, a file was rejected."""
        assert self.world.blobs.blobs == {}
        assert list(self.scratch.iterdir()) == []
        assert {field.state for field in self.world.records.list_fields(None, 10, None).records} <= {"rejected"}

    def assert_next_is_taken(self) -> None:
        """The next good upload becomes a field."""
        assert self.outcome(self.good) == "ready"
        assert self.world.client.delete(f"/fields/{sha256(self.good)}").status_code == 204


def make_house(folder: Path, redis: Redis, good: bytes) -> House:
    """A fresh one; temporary files of this process go to its own folder from now on."""
    scratch = folder / "scratch"
    scratch.mkdir()
    tempfile.tempdir = str(scratch)
    world = make_world(folder / "state", redis, max_upload_bytes=256 * MIB, keep_originals="none")
    return House(world, Context(world.settings, world.records, world.blobs, world.queue), scratch, good)
