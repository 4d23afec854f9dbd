"""Buckets of tokens: when they are empty, how they fill, and how many there are."""

from __future__ import annotations

import pytest

from regnf_service.http.middleware import Buckets


class Clock:
    """Stands still unless a test moves it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_bucket_is_full_at_first_and_fills_by_its_rate(clock: Clock) -> None:
    buckets = Buckets(2.0, 3, clock)
    assert [buckets.take("alice") for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]
    clock.now += 0.25
    assert buckets.take("alice") == 0.25
    clock.now += 0.25
    assert [buckets.take("alice") for _ in range(2)] == [0.0, 0.5]


def test_asking_an_empty_bucket_costs_nothing(clock: Clock) -> None:
    buckets = Buckets(1.0, 1, clock)
    buckets.take("alice")
    for _ in range(1000):
        assert buckets.take("alice") == 1.0
    clock.now += 1.0
    assert buckets.take("alice") == 0.0


def test_a_long_pause_fills_it_to_the_brim_and_no_further(clock: Clock) -> None:
    buckets = Buckets(10.0, 5, clock)
    buckets.take("alice")
    clock.now += 1e9
    assert [buckets.take("alice") for _ in range(6)] == [0.0] * 5 + [pytest.approx(0.1)]


def test_in_the_long_run_nobody_gets_more_than_the_rate(clock: Clock) -> None:
    buckets, taken = Buckets(10.0, 20, clock), 0
    for _ in range(60 * 64):
        clock.now += 1 / 64
        taken += buckets.take("alice") == 0.0
    assert 600 <= taken <= 620


def test_each_has_its_own(clock: Clock) -> None:
    buckets = Buckets(0.5, 1, clock)
    assert [buckets.take(who) for who in ("alice", "bob", "alice")] == [0.0, 0.0, 2.0]


def test_they_are_few_and_the_one_in_use_stays(clock: Clock) -> None:
    buckets = Buckets(0.001, 1, clock)
    for number in range(10_000):
        buckets.take("alice")
        buckets.take(f"stranger {number}")
    assert len(buckets) == 4096
    assert buckets.take("alice") > 0
