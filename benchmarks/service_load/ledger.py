"""What was asked of a service and what it has said since: anything lost, changed or done twice is a fault."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.service_load.webhook_receiver import WebhookReceiver

_FIXED = {"jobs": ("id", "kind", "created_at", "inputs"), "fields": ("sha256", "bytes", "created_at", "label")}
"""Members that never change once they were told."""
_FINAL = {
    "jobs": (
        "status",
        {"successful", "failed", "dismissed"},
        ("finished_at", "verdict", "error", "attempts", "engine"),
    ),
    "fields": ("state", {"ready", "rejected"}, ("kind", "bounds", "error")),
}
"""Members that never change once the record has ended."""
_WEBHOOKS_WITHIN_S = 300.0


@dataclass
class Job:
    """A job that was accepted: how it has to end, the number of its webhook, and the release that accepted it."""

    id: str
    ends: str
    number: int
    release: str
    ended: str | None = None


@dataclass
class Ledger:
    """Everything that was accepted, and the faults so far."""

    jobs: dict[str, Job] = field(default_factory=dict)
    fields: dict[str, str] = field(default_factory=dict)
    answers: Counter[str] = field(default_factory=Counter)
    in_flight: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    delivered: int = 0
    refused: int = 0
    _seen: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    def fault(self, text: str) -> None:
        self.faults.append(text)

    def expect_job(self, name: str, ends: str, number: int, release: str) -> None:
        self.jobs.setdefault(name, Job(name, ends, number, release))

    def expect_field(self, sha256: str, state: str) -> None:
        self.fields.setdefault(sha256, state)

    def left_in_flight(self, documents: Iterable[dict[str, Any]]) -> None:
        """Count what has not ended as a leg ends."""
        self.in_flight.update(one["status"] for one in documents if one.get("status") in ("accepted", "running"))

    def settle(self, job: Job, document: dict[str, Any]) -> None:
        """The job has ended: as it should?"""
        self.compare("jobs", job.id, document)
        job.ended = document.get("status")
        if job.ended != job.ends:
            self.fault(f"job {job.id} of {job.release} is {job.ended}, not {job.ends}: {document.get('error')}")

    def compare(self, what: str, name: str, document: dict[str, Any]) -> None:
        """What is said now against what was said before."""
        state = document.get("state")
        if what == "fields" and state not in ("validating", self.fields[name]):
            self.fault(f"field {name} is {state}, not {self.fields[name]}: {document.get('error')}")
        kept = document if what == "results" else _kept(what, document)
        before = self._seen.get((what, name), {})
        changed = [key for key, value in before.items() if kept.get(key) != value]
        if changed:
            self.fault(f"{what} {name}: {', '.join(changed)} changed")
        self._seen[what, name] = before | kept

    def webhooks(self, receiver: WebhookReceiver) -> None:
        """Wait until every job's webhook was taken."""
        numbers = {job.number for job in self.jobs.values()}
        deadline = time.monotonic() + _WEBHOOKS_WITHIN_S
        while (missing := numbers - receiver.taken.keys()) and time.monotonic() < deadline:
            time.sleep(0.5)
        if missing:
            self.fault(f"webhooks of jobs {sorted(missing)} were not sent within {_WEBHOOKS_WITHIN_S:.0f} s")
        self.delivered, self.refused = len(numbers - missing), receiver.refused

    def table(self) -> list[str]:
        ends = Counter((job.release, job.ends, job.ended) for job in self.jobs.values())
        answers = ", ".join(f"{count} {kind}" for kind, count in sorted(self.answers.items()))
        verdict = "Nothing was lost, nothing ended twice, no answer was a 5xx." if not self.faults else "Faults:"
        return [
            verdict,
            *[f"- {fault}" for fault in self.faults[:40]],
            "",
            "| accepted by | to end | ended | jobs |",
            "|---|---|---|---|",
            *[f"| {release} | {ends} | {ended} | {count} |" for (release, ends, ended), count in sorted(ends.items())],
            "",
            f"In flight as a release was stopped: {self.in_flight['running']} running, {self.in_flight['accepted']} "
            f"waiting. Fields: {len(self.fields)}. Webhooks: {self.delivered} of {len(self.jobs)} delivered, after "
            f"{self.refused} refusals. Answers: {answers}.",
        ]


def whole_once(blobs: Path, ledger: Ledger) -> list[str]:
    """Faults of the storage: a result that is missing, torn, or there twice."""
    faults = []
    for job in ledger.jobs.values():
        folder = blobs / "jobs" / job.id
        found = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
        if job.ended != "successful":
            faults += [f"job {job.id} is {job.ended} and has {found}"] if found else []
            continue
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        listed = {f"{manifest['attempt']}/{one['name']}": one["sha256"] for one in manifest["artifacts"]}
        if found != sorted(["manifest.json", *listed]):
            faults.append(f"job {job.id} has {found}")
        for name, sha256 in listed.items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != sha256:
                faults.append(f"job {job.id}: {name} is not what the manifest says")
    return faults


def _kept(what: str, document: dict[str, Any]) -> dict[str, Any]:
    key, final, more = _FINAL[what]
    names = _FIXED[what] + ((key, *more) if document.get(key) in final else ())
    return {name: document[name] for name in names if name in document}
