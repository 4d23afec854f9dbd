"""How many bytes of Redis a job takes: while it waits, and once it has ended.

    python -m benchmarks.service_load.redis_size [--jobs 3000] [--output benchmarks/results/service_redis.md]

Registrations are posted to a service without workers, as fast as one client can; then every record goes through what a
worker writes of a job, phase by phase. What Redis uses is its own `used_memory`, less what it used before.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import httpx
from redis import Redis

from benchmarks.service_load.house import House, running_house
from benchmarks.service_load.report import headed, load, write
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from tests.contract.world import BOX, field_bytes

_PHASES = ("loading", "sampling", "initializing", "optimizing", "verifying", "exporting")
_RETENTION_S = 604800


def post(house: House, jobs: int) -> tuple[list[str], float]:
    """The ids of so many waiting registrations, and how many were posted a second."""
    with httpx.Client(base_url=house.address, timeout=60) as client:
        names = [client.post("/fields", content=field_bytes(name)).json()["sha256"] for name in ("scene", "object")]
        request = {"scene": names[0], "object": names[1], "detection": BOX}
        begun = time.monotonic()
        ids = [client.post("/register", json={**request, "seed": seed}).json()["id"] for seed in range(jobs)]
        return ids, jobs / (time.monotonic() - begun)


def finish(redis: Redis, ids: list[str]) -> None:
    """Each job taken up, through its phases, and to its end; the queue forgets it."""
    records = RecordStore(redis, _RETENTION_S)
    for job_id in ids:
        records.update_job(job_id, 1, status="running", phase=_PHASES[0], worker="w" * 32)
        records.update_job(job_id, 1, engine={"version": "0.1.0", "device": "cpu"})
        for place, phase in enumerate(_PHASES[1:]):
            records.update_job(job_id, 1, phase=phase, progress=place / len(_PHASES))
        records.update_job(job_id, 1, status="successful", verdict="registered")
    for key in redis.scan_iter("rq:*", count=1000):
        redis.delete(key)


def measure(folder: Path, jobs: int) -> tuple[dict[str, float], float]:
    """Bytes a job by its state, and registrations a second."""
    with running_house(folder, 0, max_queued_jobs=jobs) as house, connect(house.redis.url) as redis:
        post_first, _ = post(house, 1)  # fields, scripts and the client's own buffers
        before = house.redis_memory(redis)
        ids, rate = post(house, jobs)
        waiting = house.redis_memory(redis)
        finish(redis, [*post_first, *ids[1:]])
        ended = house.redis_memory(redis)
    return {"waiting": (waiting - before) / (jobs - 1), "ended": (ended - before) / (jobs - 1)}, rate


def table(sizes: dict[str, float], rate: float) -> list[str]:
    return [
        "| a registration | bytes in Redis | in a gibibyte |",
        "|---|---|---|",
        *[f"| {state} | {size:.0f} | {2**30 / size:.0f} |" for state, size in sizes.items()],
        "",
        f"One client posted {rate:.0f} registrations a second, journal included.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=3000)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    loads = [load()]
    with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
        sizes, rate = measure(Path(folder), arguments.jobs)
    loads.append(load())
    command = f"python -m benchmarks.service_load.redis_size --jobs {arguments.jobs}"
    write("Redis, a job", headed(command, loads, table(sizes, rate)), arguments.output)


if __name__ == "__main__":
    main()
