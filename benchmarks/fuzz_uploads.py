"""Damaged and invented files sent to the whole service, one after the other, as a hostile client would.

    python -m benchmarks.fuzz_uploads [--cases 1000] [--seed 1] [--output FILE] [--corpus FOLDER]

The files are those of benchmarks.fuzz_gate. A case fails if the API answers 5xx or not at all, if the field does not
come to ``ready`` or ``rejected`` in three minutes, or if a rejected file leaves anything in the store; the run also if
a traceback is logged, a process ends, or a sound upload is not taken afterwards. Ends with status 1 if there are any.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from random import Random

import httpx

from tests.contract.live import Live, live_service
from tests.core.importing.fuzzing.cases import STAGES, make_case
from tests.core.importing.fuzzing.corpus import Corpus
from tests.core.importing.fuzzing.seeds import Seeds, make_seeds

_STATE_S = 180.0
_POLL_S = 0.02
_LEFT_S = 5.0


@dataclass
class Tally:
    """outcomes: how many uploads ended so · slowest: seconds from the first byte sent to the field's last state."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest: float = 0.0


def upload(client: httpx.Client, data: bytes) -> str:
    """How one upload ended: ``ready``, ``rejected REASON`` or ``refused REASON``; raises ValueError on a fault."""
    answer = client.post("/fields", content=data)
    if answer.status_code >= 500:
        raise ValueError(f"status {answer.status_code}: {answer.text:.200}")
    if answer.status_code >= 400:
        return f"refused {answer.json()['reason']}"
    place, end = answer.headers["Location"], time.monotonic() + _STATE_S
    while (document := client.get(place).json())["state"] == "validating":
        if time.monotonic() > end:
            raise ValueError(f"still validating after {_STATE_S:.0f} s")
        time.sleep(_POLL_S)
    if client.delete(place).status_code != 204:
        raise ValueError("the field could not be deleted")
    return "ready" if document["state"] == "ready" else f"rejected {document['error']['reason']}"


def run(live: Live, seeds: Seeds, cases: int, seed: int, corpus: Corpus) -> Tally:
    """Every case, each followed by a look at the store. Cases build upon ``corpus``, which keeps every new outcome."""
    tally = Tally()
    stages = [stage for stage in STAGES if stage != "pickle"]  # a bare pickle is told by its first bytes
    known: set[str] = set()
    finds = {stage: corpus.of(stage) for stage in stages}
    with live.client() as client:
        for index in range(cases):
            stage = stages[index % len(stages)]
            data = make_case(Random(f"{seed} {index}"), stage, seeds, finds[stage])
            begun = time.monotonic()
            try:
                outcome = upload(client, data)
                tally.outcomes[outcome] += 1
                if corpus.offer(stage, outcome.rpartition(" ")[2], data):
                    finds[stage].append(data)
            except (ValueError, KeyError, httpx.HTTPError) as error:
                tally.failures.append(f"case {index} ({stage}): {error!r:.300}")
            tally.slowest = max(tally.slowest, time.monotonic() - begun)
            if left := _left(live, known):
                tally.failures.append(f"case {index} ({stage}) left {sorted(left)[:3]}")
                known |= left
        try:
            after = upload(client, seeds.field_file)
        except (ValueError, KeyError, httpx.HTTPError) as error:
            after = repr(error)
    if after != "ready":
        tally.failures.append(f"a sound field afterwards: {after}")
    ended = [name for name, process in (("API", live.api), ("worker", live.worker)) if process and process.poll()]
    tally.failures += [f"the {name} ended" for name in ended]
    if "Traceback" in live.log():
        tally.failures.append("a traceback in the log")
    return tally


def _left(live: Live, known: set[str]) -> set[str]:
    """Files that are still there a little later: the journal is written once the field's state is known."""
    end = time.monotonic() + _LEFT_S
    while (left := live.files() - known) and time.monotonic() < end:
        time.sleep(_POLL_S)
    return left


def report(tally: Tally, arguments: argparse.Namespace, seconds: float, peak: int) -> str:
    command = f"python -m benchmarks.fuzz_uploads --cases {arguments.cases} --seed {arguments.seed}"
    rows = [f"| {outcome} | {count} |" for outcome, count in sorted(tally.outcomes.items())]
    return "\n".join(
        [
            f"Command: `{command}`, {datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
            f"Python {platform.python_version()}, {seconds / 60:.0f} minutes",
            "",
            *(
                [f"- {failure}" for failure in tally.failures]
                or ["No case failed; a sound field was taken afterwards."]
            ),
            "",
            "| how the upload ended | uploads |",
            "|---|---|",
            *rows,
            f"| all | {tally.outcomes.total()} |",
            "",
            f"Slowest, from its first byte to its last state: {tally.slowest:.1f} s. "
            f"The API's peak memory: {peak / 1e6:.0f} MB.",
        ]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--corpus", type=Path, help="where cases with a new outcome are kept from run to run")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-fuzz-") as name:
        folder = Path(name)
        seeds = make_seeds(folder)
        begun = time.monotonic()
        (folder / "state").mkdir()
        with live_service(folder / "state") as live:
            corpus = Corpus(arguments.corpus or folder / "corpus")
            tally = run(live, seeds, arguments.cases, arguments.seed, corpus)
            text = report(tally, arguments, time.monotonic() - begun, live.peak_memory())
    sys.stdout.write(text + "\n")
    if arguments.output:
        arguments.output.write_text(f"# Fuzzing the service's uploads\n\n{text}\n")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())
