"""Registers a thousand pairs with a service, and sorts the results: to use, to inspect, failed.

python examples/05_pipeline.py ADDRESS PAIRS.jsonl FOLDER

A line of PAIRS is {"key": ..., "scene": file, "object": file, "detection": box, "options": ...}, with files beside
PAIRS. FOLDER gets used.jsonl (poses to work with), look.jsonl (several poses, or none that is reliable) and
failed.jsonl. Given again after an interruption, it goes on: the service does nothing twice, and failed pairs are tried
again.
"""

import json
import sys
from collections import Counter
from pathlib import Path

import regnf

FILES = {"registered": "used.jsonl", "ambiguous": "look.jsonl", "rejected": "look.jsonl", None: "failed.jsonl"}


def requests(pairs: Path):
    """The lines, with the paths of their files."""
    for line in pairs.read_text().splitlines():
        pair = json.loads(line)
        yield pair | {name: str(pairs.parent / pair[name]) for name in ("scene", "object")}


def told(result: regnf.PairResult) -> dict:
    """What the next step of the pipeline needs."""
    if result.error is not None:
        return {"key": result.key, "reason": result.error.reason, "hint": result.error.hint}
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    sure = {"probability": result.probability, "level": result.level}
    return {"key": result.key, "job": result.job, **sure, "poses": [one.tolist() for one in poses]}


if len(sys.argv) != 4 or not Path(sys.argv[2]).is_file():
    sys.exit(f"usage: {__doc__}")
address, pairs, folder = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
folder.mkdir(exist_ok=True)
counts: Counter[str] = Counter()
files = {name: (folder / name).open("w") for name in set(FILES.values())}
with regnf.Client(address) as client:
    for result in client.batch(requests(pairs)):
        name = FILES[result.verdict]
        print(json.dumps(told(result)), file=files[name], flush=True)
        counts[name] += 1
print(", ".join(f"{count} in {name}" for name, count in sorted(counts.items())))
