"""Attacks on a running service, drawn at random.

    python -m benchmarks.attacks http --inputs 20000 [--seed 1] [--without-tokens] [--output FILE]
    python -m benchmarks.attacks stored-state --inputs 5000
    python -m benchmarks.attacks kills --kills 40

Every run starts a service of its own: Redis, API and workers as processes, below a temporary folder. Ends with status 1
if anything happened that should not have; docs/security.md says what that is.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.attacks.http_requests import attack_http
from benchmarks.attacks.kills import attack_by_kills
from benchmarks.attacks.outcome import Outcome
from benchmarks.attacks.stored_state import attack_stored_state
from benchmarks.service_load.report import headed, write


def run(arguments: argparse.Namespace, folder: Path) -> Outcome:
    match arguments.kind:
        case "http":
            return attack_http(folder, arguments.inputs, arguments.seed, tokens=not arguments.without_tokens)
        case "stored-state":
            return attack_stored_state(folder, arguments.inputs, arguments.seed)
        case _:
            return attack_by_kills(folder, arguments.kills, arguments.seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("http", "stored-state", "kills"))
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-tokens", action="store_true", help="http: a service that asks for no token")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    before, begun = os.getloadavg()[0], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="regnf-attacks-") as name:
        outcome = run(arguments, Path(name))
    command = "python -m benchmarks.attacks " + " ".join(sys.argv[1:])
    lines = [f"{(time.monotonic() - begun) / 60:.0f} minutes.", "", *outcome.lines()]
    write(f"Attacks: {arguments.kind}", headed(command, [before, os.getloadavg()[0]], lines), arguments.output)
    return 1 if outcome.faults else 0


if __name__ == "__main__":
    sys.exit(main())
