"""That no message of a webhook is lost and none is sent twice, also of several requests for one job."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from redis import Redis

from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import Message, RedisOutbox, line_of
from tests.service.webhook_receiver import OneByOne, Receiver, ask, deliverer, delivery, due, finish


def test_a_message_outlives_who_took_it(redis: Redis, receiver: Receiver) -> None:
    """A process that dies after it took a message: another sends it once a minute is over, not before."""
    finish(redis, receiver.address)
    assert RedisOutbox(redis).claim() == Message("j1", 1, 0, line_of("alice", receiver.address))
    assert not deliverer(redis, [receiver.address]).run_once()
    score = float(redis.zscore(due(receiver.address), "j1-1-0"))  # type: ignore[arg-type]
    assert score == pytest.approx(RecordStore(redis).now() + 60, abs=20)
    redis.zadd(due(receiver.address), {"j1-1-0": 0})
    assert deliverer(redis, [receiver.address]).run_once()
    assert len(receiver.received) == 1


def test_many_deliverers_send_each_message_once(redis: Redis, redis_url: str, receiver: Receiver) -> None:
    for number in range(12):
        finish(redis, receiver.address, name=f"job{number}")

    @contextmanager
    def one() -> Iterator[OneByOne]:
        with connect(redis_url) as own:
            yield deliverer(own, [receiver.address])

    def work() -> None:
        with one() as mine:
            while mine.run_once():
                pass

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({headers["webhook-id"] for _, headers, _ in receiver.received}) == len(receiver.received) == 12


def test_a_job_that_is_deleted_or_started_anew_takes_its_message_along(redis: Redis, receiver: Receiver) -> None:
    store, outbox = RecordStore(redis), RedisOutbox(redis)
    finish(redis, receiver.address, "failed")
    record = store.get_job("j1")
    assert record is not None
    again, _ = store.create_job(record, 10)
    assert (again.attempt, outbox.waiting(), delivery(redis).state) == (2, 0, "waiting")
    store.update_job("j1", 2, status="dismissed")
    assert (outbox.waiting(), delivery(redis).state) == (1, "pending")
    store.delete_job("j1")
    assert (outbox.waiting(), redis.exists("regnf:webhook:j1:0")) == (0, 0)
    redis.zadd(due(receiver.address), {"gone-1-0": 0})
    redis.zadd("regnf:webhooks:lines", {line_of("alice", receiver.address): 0})
    assert deliverer(redis, [receiver.address]).run_once()
    assert (receiver.received, outbox.waiting()) == ([], 0)


def test_a_webhook_that_comes_after_the_end_is_told_at_once_and_the_others_not_again(
    redis: Redis, receiver: Receiver
) -> None:
    sent = deliverer(redis, [receiver.address])
    finish(redis, f"{receiver.address}/first")
    assert (sent.run_once(), sent.run_once()) == (True, False)
    for _ in range(2):
        ask(redis, f"{receiver.address}/second")
    assert (sent.run_once(), sent.run_once()) == (True, False)
    assert [path for path, _, _ in receiver.received] == ["/first", "/second"]
    assert len({body for _, _, body in receiver.received}) == 1, "the same end"
    assert len({headers["webhook-id"] for _, headers, _ in receiver.received}) == 2, "another message"
    assert [delivery(redis, place).state for place in (0, 1)] == ["delivered", "delivered"]
    assert 0 < redis.ttl("regnf:webhook:j1:1") <= 7 * 24 * 3600  # type: ignore[operator]


def test_every_request_is_told_of_the_end_by_itself(redis: Redis, receiver: Receiver) -> None:
    store = RecordStore(redis)
    for path in ("first", "second", "third"):
        ask(redis, f"{receiver.address}/{path}")
    store.update_job("j1", 1, status="running")
    requeued = store.requeue_job("j1", 1)
    assert len(requeued.webhooks) == 3
    assert (RedisOutbox(redis).waiting(), delivery(redis, 2).state) == (0, "waiting")
    store.update_job("j1", 2, status="running")
    store.update_job("j1", 2, status="successful")
    receiver.statuses = [200, 410, 500]
    sent = deliverer(redis, [receiver.address], (60.0,))
    assert [sent.run_once() for _ in range(4)] == [True, True, True, False]
    assert sorted(path for path, _, _ in receiver.received) == ["/first", "/second", "/third"]
    assert sorted(delivery(redis, place).state for place in range(3)) == ["delivered", "failed", "pending"]


def test_all_messages_of_a_job_go_with_it(redis: Redis, receiver: Receiver) -> None:
    store, outbox = RecordStore(redis), RedisOutbox(redis)
    finish(redis, f"{receiver.address}/first", "failed")
    again = ask(redis, f"{receiver.address}/second")
    assert (again.attempt, again.webhooks) == (2, [f"{receiver.address}/second", f"{receiver.address}/first"])
    assert outbox.waiting() == 0
    store.update_job("j1", 2, status="dismissed")
    assert outbox.waiting() == 2
    store.delete_job("j1")
    assert (outbox.waiting(), redis.keys("regnf:webhook:*")) == (0, [])


def test_webhooks_that_come_at_the_same_time_are_all_kept(redis: Redis, redis_url: str, receiver: Receiver) -> None:
    finish(redis, f"{receiver.address}/0")

    def work(number: int) -> None:
        with connect(redis_url) as own:
            ask(own, f"{receiver.address}/{number}")

    threads = [threading.Thread(target=work, args=(number,)) for number in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sent = deliverer(redis, [receiver.address])
    while sent.run_once():
        pass
    assert sorted(path for path, _, _ in receiver.received) == [f"/{number}" for number in range(9)]
