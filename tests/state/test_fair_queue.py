"""Callers take turns, and nothing is lost whoever dies in between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import pytest
from redis import Redis

from regnf_state.queue import Work
from regnf_state.redis.fair_queue import FairQueue, Waiting

LISTS = ("rq:queue:regnf-import", "rq:queue:regnf")


def import_of(owner: str, number: int) -> Work:
    return Work("import", f"{number:064x}_{owner}", 1)


def job_of(owner: str, number: int) -> Work:
    return Work("registration", f"{owner}-{number}", 1)


@dataclass
class Shop:
    """A fair queue and workers that take what is next."""

    redis: Redis

    def __post_init__(self) -> None:
        self.fair = FairQueue(self.redis)

    def enqueue(self, work: Work, owner: str, of_batch: bool = False) -> bool:
        return self.fair.enqueue(Waiting(work, owner, {"owner": owner}, of_batch))[0]

    def pop(self) -> str | None:
        self.fair.turn()
        found = next((name for key in LISTS if (name := self.redis.lpop(key))), None)
        return found.decode() if found else None

    def take(self) -> str | None:
        name = self.pop()
        self.fair.turn()
        return name

    def owner(self, name: str) -> str:
        return self.redis.hget(f"rq:job:{name}", "owner").decode()

    def owners(self, count: int) -> str:
        """Of what the workers take next."""
        return "".join(self.owner(str(self.take())) for _ in range(count))

    def waiting(self) -> Counter[str]:
        """How often each name lies in a list, a line or among those that wait for a field."""
        keys = [*LISTS, *self.redis.keys("regnf:queue:line:*"), *self.redis.keys("regnf:queue:parked:*")]
        return Counter(name.decode() for key in keys for name in self.redis.lrange(key, 0, -1))


@pytest.fixture
def shop(redis: Redis) -> Shop:
    return Shop(redis)


def test_one_caller_s_imports_do_not_keep_another_waiting(shop: Shop) -> None:
    for number in range(300):
        shop.enqueue(import_of("greedy", number), "greedy")
    assert shop.take() == import_of("greedy", 0).name
    shop.enqueue(job_of("honest", 1), "honest")
    assert shop.fair.position(job_of("honest", 1)) == 2, "after what lies ready for a worker"
    assert [shop.take(), shop.take()] == [import_of("greedy", 1).name, job_of("honest", 1).name]


@pytest.mark.parametrize("owners", ["ab", "abcd"])
def test_callers_take_turns_however_much_each_has_waiting(shop: Shop, owners: str) -> None:
    for place, owner in enumerate(owners, 1):
        for number in range(8 * place):
            shop.enqueue(job_of(owner, number), owner)
    assert [(line.owner, line.waiting) for line in shop.fair.lines()] == [
        (owner, 8 * place) for place, owner in enumerate(owners, 1)
    ]
    assert shop.owners(1) == "a", "who came first, and alone"
    turns = shop.owners(7 * len(owners))
    assert {turns[start : start + len(owners)] for start in range(0, len(turns), len(owners))} == {owners}
    assert shop.owners(2 * (len(owners) - 1)).count("b") == 2, "the others go on without whoever has nothing left"


@pytest.mark.parametrize("others", [1, 3])
def test_coming_and_going_gains_no_turns(shop: Shop, others: int) -> None:
    """A caller who always has its next work sent when the last was taken has no more than who sends all at once."""
    for number in range(40):
        for other in range(others):
            shop.enqueue(job_of(f"{other}", number), f"{other}")
    shop.owners(5)
    turns = ""
    for number in range(6):
        shop.enqueue(job_of("c", number), "c")
        while turns.count("c") <= number:
            turns += shop.owners(1)
    served = turns.split("c")[1:-1]
    assert all(len(between) >= others for between in served), turns


def test_a_caller_s_own_work_keeps_its_order(shop: Shop) -> None:
    works = [import_of("a", 2), job_of("a", 1), import_of("a", 1), job_of("a", 0)]
    for work in works:
        shop.enqueue(work, "a")
    shop.enqueue(job_of("b", 1), "b")
    order = [shop.take() for _ in range(5)]
    assert [name for name in order if name != "b-1-1"] == [work.name for work in works]


def test_what_waits_for_an_import_comes_first_afterwards(shop: Shop) -> None:
    reference = "f" * 64
    for number in range(4):
        shop.enqueue(job_of("a", number), "a")
    for number in (0, 1):
        assert shop.take() == f"a-{number}-1"
        shop.fair.park(job_of("a", number), "a", reference)
    assert shop.fair.holds("a-0-1")
    assert shop.fair.awaited() == [reference]
    assert not shop.enqueue(job_of("a", 0), "a"), "it waits already"
    shop.fair.release(reference)
    assert shop.fair.awaited() == []
    assert [shop.take() for _ in range(4)] == ["a-2-1", "a-0-1", "a-1-1", "a-3-1"], "one lay ready already"


# death between any two steps

STEPS: list[Callable[[Shop], object]] = [
    lambda shop: shop.fair.turn(),
    lambda shop: shop.redis.lpop("rq:queue:regnf"),
    lambda shop: shop.fair.turn(),
    lambda shop: shop.fair.park(job_of("a", 0), "a", "f" * 64),
    lambda shop: shop.fair.release("f" * 64),
    lambda shop: shop.take(),
]


@pytest.mark.parametrize("done", range(len(STEPS) + 1))
def test_work_is_found_again_whichever_step_was_the_last(shop: Shop, done: int) -> None:
    """What waits is held; what was taken and is run by nobody is not, and is queued once more when the reaper asks."""
    shop.enqueue(job_of("a", 0), "a")
    shop.enqueue(job_of("b", 0), "b")
    for step in STEPS[:done]:
        step(shop)
    shop.fair.turn()
    for reference in shop.fair.awaited():
        shop.fair.release(reference)
    for owner in "ab":
        if not shop.fair.holds(f"{owner}-0-1"):
            shop.enqueue(job_of(owner, 0), owner)
    assert shop.waiting() == {"a-0-1": 1, "b-0-1": 1}
    assert {shop.take() for _ in range(2)} == {"a-0-1", "b-0-1"}
    assert shop.take() is None
    assert shop.waiting() == {}


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_lost_or_doubled_whatever_happens_in_whatever_order(any_redis: Redis, seed: int) -> None:
    random, shop = Random(seed), Shop(any_redis)
    owners = ["a", "b", "c"]
    waiting: set[str] = set()
    running: dict[str, Work] = {}
    works: dict[str, Work] = {}
    for number in range(300):
        owner = random.choice(owners)
        match random.choice(["enqueue", "enqueue", "take", "take", "finish", "park", "release", "remove", "turn"]):
            case "enqueue":
                work = (job_of if random.random() < 0.5 else import_of)(owner, number)
                works[work.name] = work
                shop.enqueue(work, owner)
                waiting.add(work.name)
            case "take" if name := (shop.take() if random.random() < 0.5 else shop.pop()):
                waiting.remove(name)
                running[name] = works[name]
            case "finish" if running:
                running.popitem()
            case "park" if running:
                name, work = running.popitem()
                shop.fair.park(work, shop.owner(name), f"field {random.randrange(3)}")
                waiting.add(name)
            case "release":
                shop.fair.release(f"field {random.randrange(3)}")
            case "remove" if waiting:
                name = random.choice(sorted(waiting))
                assert shop.fair.remove(name)
                waiting.remove(name)
            case _:
                shop.fair.turn()
        assert shop.waiting() == dict.fromkeys(waiting, 1)
        assert all(shop.fair.holds(name) for name in waiting)
        assert sum(any_redis.llen(key) for key in LISTS) <= 1
    for number in range(3):
        shop.fair.release(f"field {number}")
    left = [shop.take() for _ in range(len(waiting) + 1)]
    assert set(left) == waiting | {None}
    assert shop.fair.lines() == []


def test_what_is_posted_by_itself_goes_before_batches(any_redis: Redis) -> None:
    shop = Shop(any_redis)
    for number in range(100):
        assert shop.enqueue(job_of("a", number), "a", of_batch=True)
    first = shop.take()
    for number in (200, 201):
        shop.enqueue(job_of("a", number), "a")
    shop.enqueue(import_of("a", 1), "a")
    assert shop.enqueue(job_of("a", 300), "a", of_batch=True)
    assert shop.fair.position(job_of("a", 201)) == 3
    order = [first, *(shop.take() for _ in range(103))]
    itself = [job_of("a", 200).name, job_of("a", 201).name, import_of("a", 1).name]
    assert order == ["a-0-1", "a-1-1", *itself, *(f"a-{number}-1" for number in [*range(2, 100), 300])]
