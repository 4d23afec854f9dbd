"""Callers take turns by what their work costs, and nothing is lost whoever dies in between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from random import Random

import pytest
from redis import Redis

from regnf_state.queue import Work
from regnf_state.redis.fair_queue import FairQueue

LISTS = ("rq:queue:regnf-import", "rq:queue:regnf")


def import_of(owner: str, number: int) -> Work:
    return Work("import", f"{number:064x}_{owner}", 1)


def job_of(owner: str, number: int) -> Work:
    return Work("registration", f"{owner}-{number}", 1)


@dataclass
class Shop:
    """A fair queue and workers that take what is next; work costs what its owner's does."""

    redis: Redis
    weights: dict[str, float] = field(default_factory=dict)
    served: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.fair = FairQueue(self.redis, self.weights)

    def enqueue(self, work: Work, owner: str) -> None:
        assert self.fair.enqueue(work, owner, {"owner": owner})

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

    def run(self, costs: dict[str, float]) -> str | None:
        """One worker takes the next, and has it done."""
        name = self.take()
        if name is not None:
            self.end(name, costs)
        return name

    def end(self, name: str, costs: dict[str, float]) -> None:
        owner = self.owner(name)
        self.served[owner] += costs[owner]
        self.fair.finish(name, costs[owner])

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
    running = shop.take()
    shop.enqueue(job_of("honest", 1), "honest")
    assert running == import_of("greedy", 0).name
    assert shop.fair.position(job_of("honest", 1)) == 1
    assert shop.take() == job_of("honest", 1).name, "although another's lay in the list before"
    assert shop.take() == import_of("greedy", 1).name


@pytest.mark.parametrize("costs", [{"a": 1.0, "b": 1.0}, {"a": 120.0, "b": 2.0}, {"a": 0.1, "b": 7.0}])
@pytest.mark.parametrize("weights", [{}, {"a": 3.0}])
@pytest.mark.parametrize("workers", [1, 3])
def test_callers_get_their_shares_of_worker_seconds(
    redis: Redis, costs: dict[str, float], weights: dict[str, float], workers: int
) -> None:
    """However costs compare with what was estimated: by as much as the work that is under way, and the first guess."""
    shop = Shop(redis, weights)
    queued: Counter[str] = Counter()
    taken: list[tuple[float, str]] = []
    clock, lead, numbers = 0.0, 0.0, count()
    for _ in range(400):
        for owner in costs:
            while queued[owner] < 5:
                shop.enqueue(job_of(owner, next(numbers)), owner)
                queued[owner] += 1
        while len(taken) < workers:
            name = shop.take()
            assert name is not None
            queued[shop.owner(name)] -= 1
            taken.append((clock + costs[shop.owner(name)], name))
        taken.sort()
        clock, name = taken.pop(0)
        shop.end(name, costs)
        shares = {owner: shop.served[owner] / weights.get(owner, 1.0) for owner in costs}
        lead = max(lead, abs(shares["a"] - shares["b"]))
    assert lead <= (workers + 1) * (max(costs.values()) + 10.0)


def test_a_caller_who_was_idle_gains_a_minute_of_work_at_most(shop: Shop) -> None:
    costs = {"busy": 5.0, "late": 5.0}
    for number in range(80):
        shop.enqueue(job_of("busy", number), "busy")
    for _ in range(40):
        shop.run(costs)
    before = shop.served["busy"]
    for number in range(40):
        shop.enqueue(job_of("late", number), "late")
    for _ in range(10):
        shop.run(costs)
    assert (shop.served["late"], shop.served["busy"]) == (50.0, before), "its first work goes first"
    for _ in range(30):
        shop.run(costs)
    assert abs(shop.served["late"] - (shop.served["busy"] - before) - 60.0) <= 15


def test_coming_and_going_renews_no_credit(shop: Shop) -> None:
    """A caller who always has its next work sent when the last has ended has no more than one who sends all at once."""
    costs = {"busy": 5.0, "comes": 5.0}
    for number in range(100):
        shop.enqueue(job_of("busy", number), "busy")
    for _ in range(40):
        shop.run(costs)
    before = shop.served["busy"]
    for number in range(40):
        shop.enqueue(job_of("comes", number), "comes")
        while shop.owner(str(shop.run(costs))) != "comes":
            pass
    assert shop.served["comes"] - (shop.served["busy"] - before) <= 75


def test_a_caller_s_own_work_keeps_its_order(shop: Shop) -> None:
    works = [import_of("a", 2), job_of("a", 1), import_of("a", 1), job_of("a", 0)]
    for work in works:
        shop.enqueue(work, "a")
    shop.enqueue(job_of("b", 1), "b")
    order = [shop.run({"a": 3.0, "b": 1.0}) for _ in range(5)]
    assert [name for name in order if name != "b-1-1"] == [work.name for work in works]


def test_what_waits_for_an_import_pays_nothing_and_comes_first_afterwards(shop: Shop) -> None:
    reference = "f" * 64
    for number in range(4):
        shop.enqueue(job_of("a", number), "a")
    for number in (0, 1):
        assert shop.take() == f"a-{number}-1"
        shop.fair.park(job_of("a", number), "a", reference)
    assert shop.fair.holds("a-0-1")
    assert shop.fair.awaited() == [reference]
    assert sum(shop.fair.spent("a").values()) == 0.0
    assert not shop.fair.enqueue(job_of("a", 0), "a", {"owner": "a"}), "it waits already"
    shop.fair.release(reference)
    assert shop.fair.awaited() == []
    assert [shop.run({"a": 1.0}) for _ in range(4)] == ["a-0-1", "a-1-1", "a-2-1", "a-3-1"]


def test_measured_seconds_replace_the_estimate(shop: Shop) -> None:
    for number in range(3):
        shop.enqueue(job_of("a", number), "a")
    shop.run({"a": 7.0})
    assert sum(shop.fair.spent("a").values()) == pytest.approx(7.0)
    shop.take()
    assert sum(shop.fair.spent("a").values()) == pytest.approx(14.0), "what runs counts as the last did"
    assert [(line.owner, line.waiting) for line in shop.fair.lines()] == [("a", 1)]
    assert shop.redis.hget("regnf:counters", "worker_seconds|a|registration") == b"7"


# death between any two steps

STEPS: list[Callable[[Shop], object]] = [
    lambda shop: shop.fair.turn(),
    lambda shop: shop.redis.lpop("rq:queue:regnf"),
    lambda shop: shop.fair.turn(),
    lambda shop: shop.fair.park(job_of("a", 0), "a", "f" * 64),
    lambda shop: shop.fair.release("f" * 64),
    lambda shop: shop.take(),
    lambda shop: shop.fair.finish("a-0-1", 1.0),
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
    assert {shop.run({"a": 1.0, "b": 1.0}) for _ in range(2)} == {"a-0-1", "b-0-1"}
    assert shop.take() is None
    assert shop.waiting() == {}


@pytest.mark.parametrize("seed", range(20))
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
                shop.fair.finish(running.popitem()[0], random.random() * 100)
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
    fair, shop = FairQueue(any_redis), Shop(any_redis)
    for number in range(100):
        assert fair.enqueue(job_of("a", number), "a", {"owner": "a"}, of_batch=True)
    first = shop.take()
    for number in (200, 201):
        shop.enqueue(job_of("a", number), "a")
    shop.enqueue(import_of("a", 1), "a")
    assert fair.enqueue(job_of("a", 300), "a", {"owner": "a"}, of_batch=True)
    assert fair.position(job_of("a", 201)) == 2
    order = [first, *(shop.take() for _ in range(103))]
    itself = [job_of("a", 200).name, job_of("a", 201).name, import_of("a", 1).name]
    assert order == ["a-0-1", *itself, *(f"a-{number}-1" for number in [*range(1, 100), 300])]
