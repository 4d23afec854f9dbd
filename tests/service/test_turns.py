"""In which order requests begin that came in at the same time."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Callable

from regnf_service.concurrency import Threads, whose
from regnf_service.http.middleware import AT_ONCE, Turns, fair_key


def test_callers_take_turns() -> None:
    """The first of them comes at once: nobody waits when it asks."""
    seen: list[str] = []

    async def ask(turns: Turns, who: str) -> None:
        await turns.come(who)
        seen.append(who)

    async def all_at_once() -> None:
        turns = Turns()
        await turns.come("somebody")
        async with asyncio.TaskGroup() as group:
            for who in [*["greedy"] * 50, "honest", "honest"]:
                group.create_task(ask(turns, who))

    asyncio.run(all_at_once())
    assert len(seen) == 52
    assert seen[:6].count("honest") == 2


def test_a_few_begin_in_each_turn_of_the_loop() -> None:
    async def counted() -> int:
        turns, begun = Turns(), 0

        async def ask() -> None:
            nonlocal begun
            await turns.come("caller")
            begun += 1

        asking = [asyncio.create_task(ask()) for _ in range(100)]
        for _ in range(10):
            await asyncio.sleep(0)
        seen = begun
        await asyncio.gather(*asking)
        assert begun == 100
        return seen

    assert 0 < asyncio.run(counted()) <= 10 * AT_ONCE


def test_who_leaves_keeps_nobody_waiting() -> None:
    async def leave() -> list[bool]:
        turns = Turns()
        asking = [asyncio.create_task(turns.come("caller")) for _ in range(5)]
        await asyncio.sleep(0)
        asking[1].cancel()
        await asyncio.gather(*asking, return_exceptions=True)
        await turns.come("caller")
        return [one.cancelled() for one in asking]

    assert asyncio.run(leave()) == [False, True, False, False, False]


def test_an_address_is_no_callers_name() -> None:
    assert fair_key({"client": ("10.1.2.3", 5)}, "anonymous") == "anonymous 10.1.2.3"
    assert fair_key({"client": ("10.1.2.3", 5)}, "alice") == "alice"
    assert fair_key({"client": None}, "anonymous") == "anonymous "


async def eventually(look: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not look():
            await asyncio.sleep(0.01)


def test_threads_go_round_between_callers_and_none_has_all() -> None:
    begun: list[str] = []
    together: Counter[str] = Counter()
    most: Counter[str] = Counter()
    lock, go = threading.Lock(), threading.Semaphore(0)

    def work(who: str) -> None:
        with lock:
            begun.append(who)
            together[who] += 1
            most[who] = max(most[who], together[who])
        go.acquire(timeout=20)
        with lock:
            together[who] -= 1

    async def ask(threads: Threads, who: str) -> None:
        whose.set(who)
        await threads.run(work, who)

    async def all_at_once() -> None:
        threads = Threads("of the test", 4, 3)
        asking = [asyncio.create_task(ask(threads, "greedy")) for _ in range(30)]
        await eventually(lambda: len(begun) == 3)
        asking += [asyncio.create_task(ask(threads, who)) for who in ("honest", "other", "honest")]
        await eventually(lambda: len(begun) == 4)
        assert sorted(begun) == ["greedy", "greedy", "greedy", "honest"]
        asking[10].cancel()
        for count in (5, 6, 7):  # one ends, then one begins
            go.release()
            await eventually(lambda count=count: len(begun) == count)  # type: ignore[misc]
        go.release(40)
        await asyncio.gather(*asking, return_exceptions=True)
        await ask(threads, "last")

    asyncio.run(all_at_once())
    assert set(begun[4:7]) >= {"honest", "other"}
    assert most["greedy"] <= 3
    assert Counter(begun) == {"greedy": 29, "honest": 2, "other": 1, "last": 1}
