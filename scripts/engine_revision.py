"""Run this when the engine's code has changed: it records what has become of the golden registrations.

    python -m scripts.engine_revision            # about half a minute
    python -m scripts.engine_revision --raise    # the results change where no golden registration looks

Same results: the digest of the engine's code is recorded again, and nothing else changes. Other results: they are
recorded, and the revision is raised in regnf_core/version.py, so that no service returns a result of the older
engine. What changed is printed, for the changelog. Both files belong into the commit that changes the engine.
"""

from __future__ import annotations

import tests.environment  # noqa: F401 -- first

# isort: split
import argparse
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from scripts.engine_sources import source_digest
from tests.golden.cases import Case, cases
from tests.golden.records import RECORDED, Recorded, differences, record_of

ROOT = Path(__file__).resolve().parents[1]
REVISION_FILE = ROOT / "regnf_core" / "version.py"
_STATEMENT = re.compile(r"^ENGINE_REVISION = (\d+)$", re.MULTILINE)


def changes_since(recorded: Recorded, golden: Mapping[str, Case], found: Mapping[str, dict[str, Any]]) -> list[str]:
    """A sentence for each result that is not the recorded one. Cases that are new change no result."""
    gone = [f"{name}: no longer a case" for name in recorded.results if name not in golden]
    known = [name for name in golden if name in recorded.results]
    return gone + [text for name in known for text in differences(golden[name], recorded.results[name], found[name])]


def next_record(
    recorded: Recorded, found: Mapping[str, dict[str, Any]], sources: str, changes: list[str], raised: bool
) -> Recorded:
    """What golden.json says next: recorded values stay where they are the same but for the processor's rounding."""
    if changes or raised:
        return Recorded(recorded.revision + 1, sources, dict(found))
    return Recorded(recorded.revision, sources, {name: recorded.results.get(name, one) for name, one in found.items()})


def write_revision(revision: int, path: Path = REVISION_FILE) -> None:
    """Put the number into the module that holds it. Raises ValueError when it has no such statement."""
    text, count = _STATEMENT.subn(f"ENGINE_REVISION = {revision}", path.read_text(encoding="utf-8"))
    if count != 1:
        raise ValueError(f"{path.name} has no line ENGINE_REVISION = <number>")
    path.write_text(text, encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--raise", dest="raised", action="store_true", help="raise the revision in any case")
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    golden = {case.name: case for case in cases()}
    found = {}
    for name, case in golden.items():
        found[name] = record_of(case.run())
        print(f"{name}: {found[name]['verdict']}", flush=True)
    recorded = Recorded.load()
    changes = changes_since(recorded, golden, found)
    new = next_record(recorded, found, source_digest(ROOT), changes, asked.raised)
    new.save()
    write_revision(new.revision)
    print("\n".join(changes))
    if new.revision == recorded.revision:
        print(f"The results are those of revision {new.revision}; {RECORDED.name} has the digest of the present code.")
    else:
        print(f"The engine's revision is {new.revision} now. Say in CHANGELOG.md what changed.")


if __name__ == "__main__":
    main()
