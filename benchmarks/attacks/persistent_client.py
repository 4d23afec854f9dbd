"""A client of a service whose processes die: it asks again while there is no answer, and looks at what it gets."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx

from benchmarks.attacks.deaths import Deaths
from benchmarks.attacks.outcome import Outcome
from benchmarks.service_load.house import House
from regnf_state.manifest import manifest_key

_MOST_S = 240.0
"""What was accepted has to end this long after the last death."""
_ENDS = ("successful", "failed", "dismissed")


@dataclass(frozen=True)
class PersistentClient:
    """What it was told is in ``outcome``. ``deaths`` tell what may end without a result."""

    house: House
    outcome: Outcome
    deaths: Deaths

    def upload(self, data: bytes) -> str | None:
        """The SHA-256 of the field; None when its import died too often. Raises AssertionError, TimeoutError."""
        begun = time.monotonic()
        answer = self._ask(
            lambda: httpx.post(f"{self.house.address}/fields", content=data, timeout=60), (200, 201, 202)
        )
        self.outcome.inputs += 1
        place = f"{self.house.address}{answer.headers['Location']}"
        document = self._followed(place, lambda one: one["state"] != "validating")
        self.outcome.ends[f"field {document['state']} {_reason(document)}".strip()] += 1
        if document["state"] == "ready":
            return str(document["sha256"])
        self._require_deaths("an upload", document, begun)
        return None

    def register(self, request: dict[str, Any]) -> None:
        """Register, and check that there is one whole result. Raises AssertionError, TimeoutError."""
        begun = time.monotonic()
        answer = self._ask(lambda: httpx.post(f"{self.house.address}/register", json=request, timeout=60), (200, 202))
        self.outcome.inputs += 1
        job = answer.json()["id"]
        place = f"{self.house.address}/jobs/{job}"
        document = self._followed(place, lambda one: one["status"] in _ENDS)
        self.outcome.ends[f"job {document['status']} {_reason(document)}".strip()] += 1
        if document["status"] == "failed":
            self._require_deaths(f"job {job}", document, begun)
            return
        result = self._ask(lambda: httpx.get(f"{place}/result", timeout=60), (200,)).json()
        assert result["verdict"] == "registered", f"job {job}: {result['verdict']}"
        manifests = list((self.house.folder / "state" / "blobs").glob(manifest_key(job)))
        assert len(manifests) == 1, f"job {job} has {len(manifests)} manifests"

    def _require_deaths(self, what: str, document: dict[str, Any], begun: float) -> None:
        found = f"{what} ended as {document.get('error')} after {self.deaths.since(begun)} deaths"
        assert self.deaths.excuse(_reason(document), begun), found

    def _followed(self, place: str, ended: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        begun = time.monotonic()
        while True:
            document: dict[str, Any] = self._ask(lambda: httpx.get(place, timeout=60), (200,)).json()
            if ended(document):
                return document
            if time.monotonic() > self.deaths.last_end(begun) + _MOST_S:
                raise TimeoutError(f"{place} has not ended after {_MOST_S:.0f} s: {str(document)[:400]}")
            time.sleep(0.2)

    def _ask(self, call: Callable[[], httpx.Response], statuses: tuple[int, ...]) -> httpx.Response:
        """An answer with one of the statuses: asked for again while the service is away, as a client should."""
        begun = time.monotonic()
        while True:
            try:
                answer = call()
            except httpx.TransportError as error:
                self.outcome.ends[f"asked again: {type(error).__name__}"] += 1
            else:
                if answer.status_code in statuses:
                    return answer
                reason = answer.json().get("reason", "")
                self.outcome.ends[f"asked again: {answer.status_code} {reason}"] += 1
                if answer.status_code not in (404, 409, 429, 503, 507):
                    raise AssertionError(f"{answer.request.url}: {answer.status_code} {reason}")
            if time.monotonic() > self.deaths.last_end(begun) + _MOST_S:
                raise TimeoutError(f"no answer within {_MOST_S:.0f} s")
            time.sleep(0.3)


def _reason(document: dict[str, Any]) -> str:
    return str((document.get("error") or {}).get("reason", ""))
