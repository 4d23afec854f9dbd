"""Webhooks: what arrives, how often, and where it may go, with a real receiver and a real Redis."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from redis import Redis

from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.webhook_outbox import Message, RedisOutbox, line_of
from tests.service.conftest import KEY, OneByOne, Receiver, ask, deliverer, delivery, due, finish, hmac_by_hand


def test_a_name_that_resolves_to_a_private_address_is_not_followed(redis: Redis, receiver: Receiver) -> None:
    named = receiver.address.replace("127.0.0.1", "localhost")
    finish(redis, f"{named}/x")
    assert deliverer(redis, [named]).run_once()
    assert (receiver.received, delivery(redis).last_error) == ([], "ADDRESS_NOT_ALLOWED")
    # the list names the address itself, though with another port: then it is followed there
    assert deliverer(redis, [named, "127.0.0.1", "[::1]"]).run_once()
    assert delivery(redis).state == "delivered"


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_a_message_arrives_signed(redis: Redis, receiver: Receiver, status: str) -> None:
    record = finish(redis, f"{receiver.address}/hook?x=1", status)
    sent = deliverer(redis, [receiver.address])
    assert (sent.run_once(), sent.run_once()) == (True, False)
    (path, headers, body) = receiver.received[0]
    assert (path, headers["content-type"], len(receiver.received)) == ("/hook?x=1", "application/json", 1)
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    assert headers["webhook-signature"] == "v1," + base64.b64encode(hmac_by_hand(KEY, signed)).decode()
    assert abs(int(headers["webhook-timestamp"]) - RecordStore(redis).now()) < 60
    assert "." not in headers["webhook-id"]
    message = json.loads(body)
    assert message["type"] == f"job.{status}"
    assert message["data"]["reason"] == ("NO_SURFACE_IN_DETECTION" if status == "failed" else None)
    assert (message["data"]["id"], message["data"]["attempt"]) == (record.id, 1)
    found = delivery(redis)
    assert (found.state, found.sends, found.last_status) == ("delivered", 1, 200)
    assert found.delivered_at is not None
    assert 0 < redis.ttl("regnf:webhook:j1:0") <= 7 * 24 * 3600  # type: ignore[operator]


def test_sends_are_repeated_with_the_same_id_and_body(redis: Redis, receiver: Receiver) -> None:
    receiver.statuses = [500, 429, 204]
    finish(redis, receiver.address)
    sent = deliverer(redis, [receiver.address])
    assert [sent.run_once() for _ in range(4)] == [True, True, True, False]
    assert len({(headers["webhook-id"], body) for _, headers, body in receiver.received}) == 1
    found = delivery(redis)
    assert (found.state, found.sends, found.last_status) == ("delivered", 3, 204)


def test_pauses_grow_and_end(redis: Redis, receiver: Receiver) -> None:
    receiver.statuses = [500]
    finish(redis, receiver.address)
    sent, outbox = deliverer(redis, [receiver.address], (60.0, 3600.0)), RedisOutbox(redis)
    for sends, pause in ((1, 60), (2, 3600)):
        now = RecordStore(redis).now()
        assert sent.run_once()
        found = delivery(redis)
        assert (found.state, found.sends, found.next_at is not None) == ("pending", sends, True)
        assert found.next_at == pytest.approx(now + pause, abs=20)
        assert not sent.run_once(), "not before its time"
        redis.zadd(due(receiver.address), {"j1-1-0": 0})
    assert sent.run_once()
    found = delivery(redis)
    assert (found.state, found.sends, found.next_at, outbox.waiting()) == ("failed", 3, None, 0)


@pytest.mark.parametrize(("status", "state"), [(410, "failed"), (302, "pending"), (404, "pending"), (307, "pending")])
def test_redirects_are_not_followed_and_gone_is_gone(redis: Redis, receiver: Receiver, status: int, state: str) -> None:
    receiver.statuses, receiver.location = [status, 200], f"{receiver.address}/elsewhere"
    finish(redis, f"{receiver.address}/here")
    deliverer(redis, [receiver.address], (60.0,)).run_once()
    assert [path for path, _, _ in receiver.received] == ["/here"]
    found = delivery(redis)
    assert (found.state, found.last_status) == (state, status)


def test_a_receiver_that_is_not_there(redis: Redis, receiver: Receiver) -> None:
    finish(redis, "http://127.0.0.1:1/x")
    deliverer(redis, ["http://127.0.0.1:1"], (60.0,)).run_once()
    assert delivery(redis).last_error == "CONNECTION_FAILED"


def test_a_host_that_was_struck_off_the_list_is_told_nothing(redis: Redis, receiver: Receiver) -> None:
    finish(redis, receiver.address)
    deliverer(redis, ["hooks.example.org"], (60.0,)).run_once()
    assert (receiver.received, delivery(redis).last_error) == ([], "WEBHOOK_NOT_ALLOWED")


# that no message of a webhook is lost and none is sent twice, also of several requests for one job


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
    finish(redis, f"{receiver.address}/first", "failed")
    again = ask(redis, f"{receiver.address}/second")
    assert (again.attempt, again.webhooks) == (2, [f"{receiver.address}/second", f"{receiver.address}/first"])
    assert (outbox.waiting(), delivery(redis).state) == (0, "waiting")
    store.update_job("j1", 2, status="dismissed")
    assert (outbox.waiting(), delivery(redis).state) == (2, "pending")
    store.delete_job("j1")
    assert (outbox.waiting(), redis.keys("regnf:webhook:*")) == (0, [])
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
