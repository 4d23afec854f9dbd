"""Registers a long list of pairs, and continues after an interruption.

python examples/04_many_pairs.py PAIRS.jsonl RESULTS.jsonl

A line of PAIRS is {"id": ..., "scene": file, "object": file, "detection": file}; a line of RESULTS is written when
its pair is done. The pairs of one scene and one object share the scene's field and the object's model.
"""

import json
import sys
from itertools import groupby
from pathlib import Path

from regnf_core import OrientedBox, RegnfError, open_field
from regnf_core.batch import register_batch


def pairs_left(pairs: Path, results: Path) -> list[dict]:
    """The pairs without a result, those of one scene together."""
    done = {json.loads(line)["id"] for line in results.read_text().splitlines()} if results.exists() else set()
    listed = [json.loads(line) for line in pairs.read_text().splitlines()]
    return sorted((pair for pair in listed if pair["id"] not in done), key=lambda pair: (pair["scene"], pair["object"]))


def line_of(pair: dict, outcome) -> str:
    if outcome.error is not None:
        return json.dumps({"id": pair["id"], "error": outcome.error.reason})
    result = outcome.result
    pose = result.T_scene_object.to_dict()
    told = {name: getattr(result, name) for name in ("verdict", "verdict_reason", "probability", "level")}
    return json.dumps({"id": pair["id"], **told, "T_scene_object": pose})


if len(sys.argv) != 3 or not Path(sys.argv[1]).is_file():
    sys.exit(f"usage: {__doc__}")
left = pairs_left(Path(sys.argv[1]), Path(sys.argv[2]))
print(f"{len(left)} pairs to do")
with Path(sys.argv[2]).open("a") as results:
    for (scene_file, object_file), group in groupby(left, key=lambda pair: (pair["scene"], pair["object"])):
        pairs = list(group)
        try:
            scene, thing = open_field(scene_file), open_field(object_file)
            boxes = [OrientedBox.from_dict(json.loads(Path(pair["detection"]).read_text())) for pair in pairs]
        except (RegnfError, OSError) as error:
            for pair in pairs:
                print(json.dumps({"id": pair["id"], "error": getattr(error, "reason", str(error))}), file=results)
            continue
        for start in range(0, len(pairs), 10):  # a result is on the disk after ten pairs at the latest
            part = slice(start, start + 10)
            for pair, outcome in zip(
                pairs[part], register_batch(scene, boxes[part], [thing], clouds=False), strict=True
            ):
                print(line_of(pair, outcome), file=results, flush=True)
