"""One frame in one call: from the bytes of a depth image, a color image and a mask to the object's pose, by stage.

    python -m benchmarks.service_load.frame [--frames 20] [--output benchmarks/results/service_frame.md]

A service as it is by default, with one worker of one thread. The frame and the model are those of examples/data/frame;
each frame differs in one pixel, so that none was seen before. The model is stored first. Pictures are not asked for:
they come after the result. Seconds by the service's own clocks; engine: `seconds_*` of the result; the frame's seconds
are the rest of the job: opening, lifting, fusing, and writing the result.
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from PIL import Image

from benchmarks.api_process import api_process
from benchmarks.service_load.overhead import processor_seconds_below
from benchmarks.service_load.report import headed, load, write
from regnf_cli.demo import running_service

_DATA = Path("examples/data/frame")
_REST_S = 1.0
STAGES = ("upload", "import", "its process", "until begun", "frame", "engine", "answer", "whole", "processor")


def forms(count: int, request: dict[str, Any]) -> list[dict[str, Any]]:
    """The bodies of so many different frames."""
    depth = np.asarray(Image.open(_DATA / "depth.png"))
    rest: dict[str, Any] = {name: (name, (_DATA / f"{name}.png").read_bytes()) for name in ("color", "mask")}
    rest["camera"] = (None, (_DATA / "camera.json").read_bytes())
    rest["request"] = (None, json.dumps(request))
    found = []
    for number in range(count):
        changed, held = depth.copy(), io.BytesIO()
        changed.flat[number] += 1
        Image.fromarray(changed).save(held, "PNG")
        found.append({"depth": ("depth", held.getvalue()), **rest})
    return found


def stages(client: httpx.Client, form: dict[str, Any], server: int) -> dict[str, float]:
    """Seconds of one call."""
    used, begun, asked = processor_seconds_below(server), time.time(), time.monotonic()
    answer = client.post("/register", files=form, headers={"Prefer": "wait=30"})
    whole, job = time.monotonic() - asked, answer.json()
    result = client.get(f"/jobs/{job['id']}/result").json()
    scene = client.get(f"/recordings/{job['inputs']['scene']}").json()
    created, started, finished, imported = (
        datetime.fromisoformat(text).timestamp()
        for text in (job["created_at"], job["started_at"], job["finished_at"], scene["updated_at"])
    )
    engine = sum(value for name, value in result["metrics"].items() if name.startswith("seconds_"))
    time.sleep(_REST_S)  # until the worker has collected the processes
    values = (created - begun, imported - created, scene["report"]["cpu_seconds"], started - imported,
              finished - started - engine, engine, begun + whole - finished, whole,
              processor_seconds_below(server) - used)  # fmt: skip
    return dict(zip(STAGES, values, strict=True))


def measure(folder: Path, frames: int) -> tuple[list[dict[str, float]], list[float]]:
    loads = [load()]
    with (
        running_service(folder, threads=1, device="cpu") as address,
        httpx.Client(base_url=address, timeout=300) as client,
    ):
        server = psutil.Process(api_process(address)).ppid()
        model = client.post("/fields", content=(_DATA / "cat.stl").read_bytes()).json()["sha256"]
        while client.get(f"/fields/{model}", params={"wait": 30}).json()["views"] in (None, "pending"):
            time.sleep(1.0)
        found = []
        for form in forms(frames + 1, {"object": model, "pictures": False}):
            found.append(stages(client, form, server))
            loads.append(load())
    return found[1:], loads  # the first one makes the object's model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as name:
        found, loads = measure(Path(name), arguments.frames)
    lines = [f"{len(found)} frames of 640 x 480. Seconds: median and 95th percentile; processor: of all processes.", "",
             "| stage | median | p95 |", "|---|---|---|"]  # fmt: skip
    for stage in STAGES:
        values = [one[stage] for one in found]
        lines.append(f"| {stage} | {statistics.median(values):.2f} | {np.percentile(values, 95):.2f} |")
    command = f"python -m benchmarks.service_load.frame --frames {arguments.frames}"
    write("One frame in one call", headed(command, loads, lines), arguments.output)


if __name__ == "__main__":
    main()
