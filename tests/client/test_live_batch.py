"""A batch at a real service with its worker: the client, and the example that sorts its results."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from regnf_client import Client, Pair
from tests.contract.live import Live
from tests.live_stack import DATA, LIVE, ROOT

pytestmark = LIVE
ROOM, CHAIR = DATA / "mix-room.safetensors", DATA / "armchair.safetensors"
BOX = json.loads((DATA / "detection.json").read_text())
FAR = {"min": [50, 50, 50], "max": [51, 51, 51]}


def test_files_in_results_out(live_stack: Live) -> None:
    pairs = [Pair(ROOM, CHAIR, BOX, {"up_axis": "z"}, seed=5100 + number, key=str(number)) for number in range(3)]
    with Client(live_stack.address) as client:
        found = {one.key: one for one in client.batch([*pairs, Pair(ROOM, CHAIR, FAR, key="far")], timeout_s=250)}
        assert found["0"].job is not None
        whole = client.result(found["0"].job)
    assert {found[str(number)].status for number in range(3)} == {"successful"}
    assert found["far"].error is not None
    assert found["far"].error.reason == "DETECTION_OUTSIDE_SCENE"
    assert found["0"].T_object_scene is not None
    assert (found["0"].T_object_scene == whole.T_object_scene).all()
    assert found["0"].verdict == whole.verdict


def test_the_pipeline_sorts_what_comes_back(live_stack: Live, tmp_path: Path) -> None:
    (tmp_path / "data").symlink_to(DATA)
    pair: dict[str, Any] = {"scene": "data/mix-room.safetensors", "object": "data/armchair.safetensors"}
    lines = [
        {**pair, "key": "good", "detection": BOX, "options": {"up_axis": "z"}, "seed": 4711},
        {**pair, "key": "far", "detection": FAR},
    ]
    (tmp_path / "pairs.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    example = ROOT / "examples" / "05_pipeline.py"
    command = [sys.executable, str(example), live_stack.address, str(tmp_path / "pairs.jsonl"), str(tmp_path / "out")]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "1 in failed.jsonl, 1 in used.jsonl\n"
    (used,) = map(json.loads, (tmp_path / "out" / "used.jsonl").read_text().splitlines())
    (failed,) = map(json.loads, (tmp_path / "out" / "failed.jsonl").read_text().splitlines())
    assert (used["key"], len(used["poses"][0])) == ("good", 4)
    assert (failed["key"], failed["reason"]) == ("far", "DETECTION_OUTSIDE_SCENE")
