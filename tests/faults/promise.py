"""What the service promises whatever befalls it: no job lost, one whole result, an end in time, nothing left behind."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.contract.world import field_bytes
from tests.faults.house import House
from tests.faults.stores import left_unfinished
from tests.listing import below
from tests.worker.bench import eventually

WITHIN_S = 120.0
MEASURED = "REGNF_TEST_MEASURED"
"""The file that measurements are added to, one a line."""


@dataclass
class Fault:
    """One fault: since when it lasts, and since when it is over."""

    begun: float
    over_since: float

    def over(self) -> None:
        """What was broken is whole again; without this word the fault is a death, over at once."""
        self.over_since = time.monotonic()


@contextmanager
def fault() -> Iterator[Fault]:
    """A fault, from which the service has recovered when the block ends. Fails if that took too long, and notes it."""
    now = time.monotonic()
    one = Fault(now, now)
    yield one
    took, lasted = time.monotonic() - one.over_since, one.over_since - one.begun
    assert took <= WITHIN_S
    if MEASURED in os.environ:
        test = os.environ["PYTEST_CURRENT_TEST"].rpartition("::")[2].partition(" ")[0]
        with Path(os.environ[MEASURED]).open("a") as file:
            file.write(json.dumps({"test": test, "lasted": lasted, "took": took}) + "\n")


def results(house: House) -> dict[str, list[str]]:
    """What lies in the storage of each job, without its folder's name."""
    found: dict[str, list[str]] = {}
    for key in house.store.listing():
        top, _, rest = key.partition("/")
        if top == "jobs":
            job_id, _, name = rest.partition("/")
            found.setdefault(job_id, []).append(name)
    return found


def check_result(house: House, job_id: str) -> None:
    """One manifest, exactly the artifacts that it lists, each whole: in the storage and at the API."""
    manifest = json.loads(house.store.read(f"jobs/{job_id}/manifest.json"))
    folder = f"{manifest['attempt']}"
    listed = [f"{folder}/{one['name']}" for one in manifest["artifacts"]]
    eventually(
        lambda: sorted(results(house)[job_id]) == sorted(["manifest.json", *listed]), lambda: str(results(house))
    )
    for one in manifest["artifacts"]:
        content = house.client.get(f"/jobs/{job_id}/artifacts/{one['name']}").raise_for_status().content
        assert (len(content), hashlib.sha256(content).hexdigest()) == (one["bytes"], one["sha256"])
        assert content == house.store.read(f"jobs/{job_id}/{folder}/{one['name']}")
        if one["name"] == "aligned.ply":
            assert content == field_bytes("scene") + field_bytes("object")


def leftovers(house: House) -> list[str]:
    """Temporary files: of jobs, of dead workers, of the storage, of copies of fields, and of the system's folder."""
    states = {house.state(role) for role in ("api", "worker")}
    scratch = [state / "scratch" for state in states]
    inside = [path for top in scratch for path in below(top) if path.parent != top and path.name != ".lock"]
    parts = [path for state in states for path in (state / "field-cache").glob("*.part")]
    system = list(Path(house.environment["TMPDIR"]).iterdir())
    return [str(path) for path in (*inside, *parts, *system)] + left_unfinished(house.store)


def check_promise(house: House, successful: list[str], failed: dict[str, str] | None = None) -> dict[str, Any]:
    """Every accepted job is known once and has ended: successful with its result, or failed with its reason and none.

    Returns the jobs' documents by id.
    """
    failed = failed or {}
    documents = {job_id: house.finished(job_id) for job_id in [*successful, *failed]}
    for job_id, document in documents.items():
        expected = ("failed", failed[job_id]) if job_id in failed else ("successful", None)
        assert (document["status"], (document.get("error") or {}).get("reason")) == expected, house.log()
    listed = [job["id"] for job in house.client.get("/jobs?limit=200").raise_for_status().json()["jobs"]]
    assert sorted(listed) == sorted(documents)
    for job_id in successful:
        check_result(house, job_id)
    assert sorted(results(house)) == sorted(successful), "what failed has left nothing"
    eventually(lambda: not leftovers(house), lambda: f"left behind: {leftovers(house)}")
    return documents
