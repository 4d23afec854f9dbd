"""How many pairs a minute a batch does with more workers than a machine here has: a simulation with measured times.

    python -m benchmarks.service_load.batch_growth --pair-seconds 0.9 --front-seconds 0.02 [--output ...]

pair-seconds: a worker's processor seconds a pair · front-seconds: the front end's. Both are rows of
benchmarks.service_load.batch. Each worker has a core, and the front end has one. Simulated are the feeder's rounds, its
window, which grows with what has ended, the time that it takes to hand a pair out, and workers that take turns at what
waits. A pair's time varies by a third. Redis, the network and the storage are not simulated: the front end's time
includes its waiting for them.
"""

from __future__ import annotations

import argparse
import heapq
import random
from pathlib import Path

from benchmarks.service_load.report import headed, load, write

_ROUND_S = 0.5
_WORKERS = (1, 2, 4, 8, 16, 32, 64)
_SPREAD = 1 / 3


def pairs_a_minute(workers: int, pair_s: float, front_s: float, pairs: int = 4000) -> float:
    """By the feeder's rules: a round each half second, and twice as many jobs as have ended since the last block."""
    chance = random.Random(0)
    now, handed, ended, pace = 0.0, 0, 0, 0
    free: list[float] = [0.0] * workers  # when each worker has nothing to do
    running: list[float] = []  # when each job ends
    while ended < pairs:
        done = 0
        while running and running[0] <= now:
            heapq.heappop(running)
            done += 1
        ended += done
        pace = max(done * 2, pace // 2)  # of a second: two rounds
        room = 2 * max(workers, pace) - len(running)
        begun = now
        for _ in range(min(max(0, room), pairs - handed)):
            now += front_s
            at = max(heapq.heappop(free), now)
            end = at + pair_s * chance.uniform(1 - _SPREAD, 1 + _SPREAD)
            heapq.heappush(free, end)
            heapq.heappush(running, end)
            handed += 1
        now += max(0.0, _ROUND_S - (now - begun)) if now - begun < _ROUND_S else 0.0
        if handed == pairs and running:
            now = max(now, running[0])
    return 60 * pairs / now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair-seconds", type=float, required=True)
    parser.add_argument("--front-seconds", type=float, required=True)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    given = (arguments.pair_seconds, arguments.front_seconds)
    rates = {workers: pairs_a_minute(workers, *given) for workers in _WORKERS}
    lines = ["| workers | pairs a minute, simulated | of as many times one worker |", "|---|---|---|"]
    lines += [f"| {n} | {rate:.0f} | {100 * rate / (n * rates[1]):.0f} % |" for n, rate in rates.items()]
    asked = f"--pair-seconds {given[0]:g} --front-seconds {given[1]:g}"
    text = headed(f"python -m benchmarks.service_load.batch_growth {asked}", [load()], lines)
    write("A batch with more workers, simulated", text, arguments.output)


if __name__ == "__main__":
    main()
