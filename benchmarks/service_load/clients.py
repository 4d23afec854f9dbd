"""Clients of a service that falters: each asks until it has an answer, and knows what the answer has to be."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx

import regnf_client
from benchmarks.service_load.small_fields import EMPTY_BOX, SmallPair, submit

ENDS = ("successful", "failed", "dismissed")
_MAX_WAIT_S = 180.0
_TIMES = 5
"""How often a job that was lost for good by two deaths is posted again."""
_OPTIONS = {"up_axis": "z"}


def comparable(result: dict[str, Any]) -> dict[str, Any]:
    """What of a result follows from the question: all but the seconds, the options and where its files lie."""
    metrics = {name: value for name, value in result["metrics"].items() if not name.startswith("seconds_")}
    kept = {name: value for name, value in result.items() if name not in ("artifacts", "metrics", "options")}
    return kept | {"metrics": metrics, "artifacts": sorted(entry["name"] for entry in result["artifacts"])}


@dataclass(frozen=True)
class Expected:
    """The questions, and the result of each by its seed, asked in peace."""

    request: dict[str, Any]
    results: list[dict[str, Any]]

    @classmethod
    def of(cls, address: str, pair: SmallPair, questions: int) -> Expected:
        """Ask so many questions, which differ in their seeds. The first job makes the object's model for all others."""
        with regnf_client.Client(address) as service:
            request = {**pair.upload(service), "options": _OPTIONS}
            results = []
            for seed in range(questions):
                job = submit(service, {**request, "seed": seed})
                service.wait(job)
                results.append(comparable(service.result(job).document))
        return cls(request, results)

    def question(self, number: int) -> tuple[str, dict[str, Any]]:
        """The kind of the n-th job and its request.

        An option of the other preset makes it a job of its own, and changes nothing else.
        """
        kind = "cancelled" if number % 10 == 8 else "no surface" if number % 2 else "registration"
        box = EMPTY_BOX if kind == "no surface" else self.request["detection"]
        options = {**_OPTIONS, "optimization": {"iterations": 1 + number}}
        return kind, {**self.request, "detection": box, "options": options, "seed": self._place(number)}

    def result(self, number: int) -> dict[str, Any]:
        """What the n-th job's result has to be, where it has one."""
        return self.results[self._place(number)]

    def _place(self, number: int) -> int:
        return number // 2 % len(self.results)


class Client:
    """A client, for several threads at once.

    What it had to come back for is counted in ``troubles``, how its jobs ended in ``outcomes``.
    """

    def __init__(self, address: str, expected: Expected, outcomes: Counter[str], troubles: Counter[str]) -> None:
        self._http = httpx.Client(base_url=address, timeout=60)
        self._expected = expected
        self._outcomes = outcomes
        self._troubles = troubles

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def run(self, number: int) -> str | None:
        """One job from its POST to its compared result; what is wrong with how it ended, if anything is."""
        kind, request = self._expected.question(number)
        try:
            for again in itertools.count():
                job = self._finish(request, cancel=kind == "cancelled" and not again)
                reason = (job.get("error") or {}).get("reason")
                if reason != "WORKER_LOST" or again == _TIMES:
                    break
                self._troubles["WORKER_LOST, posted again"] += 1
            return self._judge(number, kind, job)
        except (TimeoutError, httpx.HTTPError, KeyError, ValueError) as error:
            return f"job {number} ({kind}): {error!r:.300}"

    def _finish(self, request: dict[str, Any], cancel: bool) -> dict[str, Any]:
        job = self._ask("POST", "/register", (200, 202), json=request)
        if cancel:
            self._ask("POST", f"/jobs/{job['id']}/cancel", (200, 202, 409))
        end = time.monotonic() + _MAX_WAIT_S
        while job["status"] not in ENDS:
            if time.monotonic() > end:
                raise TimeoutError(f"{job['id']} is {job['status']} after {_MAX_WAIT_S:.0f} s")
            job = self._ask("GET", f"/jobs/{job['id']}", (200,), params={"wait": 10})
        return job

    def _judge(self, number: int, kind: str, job: dict[str, Any]) -> str | None:
        reason = (job.get("error") or {}).get("reason", "")
        self._outcomes[f"{kind}: {job['status']} {reason}".rstrip()] += 1
        if kind == "no surface":
            wanted = job["status"] == "failed" and reason == "NO_SURFACE_IN_DETECTION"
            return None if wanted else f"job {number} without a surface: {job['status']} {reason}"
        if kind == "cancelled" and job["status"] == "dismissed":
            return None
        if job["status"] != "successful":
            return f"job {number} ({kind}): {job['status']} {reason}"
        result = comparable(self._ask("GET", f"/jobs/{job['id']}/result", (200,)))
        expected = self._expected.result(number)
        differing = [name for name in expected if result.get(name) != expected[name]]
        return f"job {number} has another result: {differing}" if differing else None

    def _ask(self, method: str, path: str, statuses: tuple[int, ...], **content: Any) -> dict[str, Any]:
        """The answer's document, asked for again while the service says that it cannot answer for now.

        404 is such an answer too: records that Redis has lost are made anew within seconds.
        """
        return _until(lambda: self._once(method, path, statuses, **content), f"{method} {path}")

    def _once(self, method: str, path: str, statuses: tuple[int, ...], **content: Any) -> dict[str, Any] | None:
        try:
            answer = self._http.request(method, path, **content)
        except httpx.TransportError as error:
            self._troubles[type(error).__name__] += 1
            return None
        if answer.status_code in statuses:
            document: dict[str, Any] = answer.json()
            return document
        reason = answer.json()["reason"]
        if answer.status_code not in (404, 503) and reason != "CONFLICT":
            raise ValueError(f"{method} {path}: {answer.status_code} {reason}")
        self._troubles[f"{method} {answer.status_code} {reason}"] += 1
        return None


def _until(look: Callable[[], dict[str, Any] | None], what: str) -> dict[str, Any]:
    end = time.monotonic() + _MAX_WAIT_S
    while (found := look()) is None:
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: no answer within {_MAX_WAIT_S:.0f} s")
        time.sleep(0.3)
    return found
