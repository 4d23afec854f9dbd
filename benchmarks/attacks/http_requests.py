"""Random hostile requests against a service of real processes, with another caller's things in it."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random
from urllib.parse import urlsplit

import httpx

from benchmarks.attacks.connection import Reply, exchange
from benchmarks.attacks.outcome import Outcome
from benchmarks.attacks.raw_requests import Known, RawRequest, draw
from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.small_fields import submit, write_small_pair
from regnf_client import Client

_HONEST, _GREEDY = "honest-token-of-the-tests", "greedy-token-of-the-tests"
_PATIENCE_S = 5.0
_TIMEOUT_S = 40.0
_BATCH = 200
_ON_EVERY_ANSWER = ("x-content-type-options", "cross-origin-resource-policy", "content-security-policy")


def attack_http(folder: Path, inputs: int, seed: int, tokens: bool) -> Outcome:
    """Send ``inputs`` requests, eight at a time. ``tokens``: the attacker is a second caller; else there are none."""
    settings: dict[str, object] = {"threads": 1, "quota_calls_per_s": 0}
    if tokens:
        settings["api_tokens"] = f'["honest:{_HONEST}", "greedy:{_GREEDY}"]'
    outcome = Outcome()
    with running_house(folder, 1, _HONEST if tokens else None, **settings) as house:
        known, before = _prepare(house, folder, tokens)
        address = urlsplit(house.address)
        place = (str(address.hostname), int(address.port or 0))
        with ThreadPoolExecutor(8) as pool:
            for first in range(0, inputs, _BATCH):
                drawn = [draw(Random(f"{seed} {n}"), known) for n in range(first, min(first + _BATCH, inputs))]
                replies = pool.map(lambda one: exchange(place, one.encode(), _PATIENCE_S, _TIMEOUT_S), drawn)
                for number, (made, reply) in enumerate(zip(drawn, replies, strict=True), first):
                    _judge(outcome, number, made, reply)
                _look(outcome, house, first)
        if tokens:
            _compare(outcome, house, before, known)
        outcome.peak_bytes = house.api_peak()
        log = house.log()
        if (at := log.find("Traceback")) >= 0:
            outcome.fault(f"{log.count('Traceback')} tracebacks in the log, first: {log[max(0, at - 300) : at + 3000]}")
        outcome.faults += [f"left behind: {name}" for name in house.left_behind()]
    return outcome


def _prepare(house: House, folder: Path, tokens: bool) -> tuple[Known, dict[str, object]]:
    """The honest caller's fields and finished job."""
    pair = write_small_pair(folder)
    with Client(house.address, token=_HONEST if tokens else None) as service:
        request = pair.upload(service)
        job = submit(service, request)
        service.wait(job)
        result = service.result(job).document
    fields = (request["scene"], request["object"])
    return Known(job, fields, _GREEDY if tokens else "", request, urlsplit(house.address).netloc), result


def _judge(outcome: Outcome, number: int, made: RawRequest, reply: Reply) -> None:
    outcome.inputs += 1
    outcome.ends[str(reply.status)] += 1
    told = f"input {number} ({made.method[:10]} {made.target[:60]!r}, {made.faults}): {reply.status}"
    if reply.status == -1 or (reply.status >= 500 and reply.status not in (501, 503, 505, 507)):
        outcome.fault(f"{told} {reply.body[:200]!r}")
    if made.foreign and 200 <= reply.status < 400 and reply.status != 304:
        outcome.fault(f"{told}: a foreign request was served")
    answered_by_us = reply.headers.get("x-request-id")
    if answered_by_us and (missing := [name for name in _ON_EVERY_ANSWER if name not in reply.headers]):
        outcome.fault(f"{told}: without {missing}")
    if "evil.example" in reply.headers.get("location", ""):
        outcome.fault(f"{told}: a redirect that follows the request")


def _look(outcome: Outcome, house: House, number: int) -> None:
    """The API still lives, and answers at once."""
    house.api_memory()
    begun = time.monotonic()
    status = httpx.get(house.address + "/healthz", timeout=10).status_code
    outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - begun)
    if status != 200:
        outcome.fault(f"/healthz answers {status} after input {number}")


def _compare(outcome: Outcome, house: House, before: dict[str, object], known: Known) -> None:
    """The honest caller's things are as they were, and the other caller's list does not have them."""
    with Client(house.address, token=_HONEST) as service:
        if service.result(known.job).document != before:
            outcome.fault("the honest caller's result has changed")
    headers = {"Authorization": f"Bearer {_GREEDY}"}
    for path in ("/jobs", "/fields"):
        text = httpx.get(house.address + path, headers=headers, timeout=10).text
        if known.job in text:
            outcome.fault(f"{path} of another caller lists the honest caller's job")
    honest = {"Authorization": f"Bearer {_HONEST}"}
    states = Counter(
        httpx.get(f"{house.address}/fields/{one}", headers=honest).json().get("state") for one in known.fields
    )
    if states != {"ready": len(known.fields)}:
        outcome.fault(f"the honest caller's fields are {states}")
