"""Webhooks: where they may go, how they are signed, and that each arrives, with a real receiver and a real Redis."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from redis import Redis

from regnf_service.tokens import TokensError
from regnf_service.webhooks.deliverer import Deliverer
from regnf_service.webhooks.sender import HttpSender
from regnf_service.webhooks.signing import read_secrets, signed_headers
from regnf_service.webhooks.targets import AllowList
from regnf_state.ownership import reference_of
from regnf_state.records import JobRecord
from regnf_state.redis.client import connect
from regnf_state.redis.jobs import RedisRecordStore
from regnf_state.redis.webhook_outbox import Delivery, Message, RedisOutbox

KEY = bytes(range(24))
SECRET = f"whsec_{base64.b64encode(KEY).decode()}"


def hmac_by_hand(key: bytes, message: bytes) -> bytes:
    """HMAC-SHA256 from its definition (RFC 2104), for keys of at most 64 bytes."""
    padded = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + message).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()


class Receiver:
    """Answers with the statuses it is given, the last one for ever; keeps what it was sent."""

    def __init__(self) -> None:
        self.statuses = [200]
        self.location = ""
        self.received: list[tuple[str, dict[str, str], bytes]] = []
        self.address = ""


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            made.received.append((self.path, {name.lower(): value for name, value in self.headers.items()}, body))
            self.send_response(made.statuses.pop(0) if len(made.statuses) > 1 else made.statuses[0])
            if made.location:
                self.send_header("Location", made.location)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        made.address = f"http://127.0.0.1:{server.server_port}"
        yield made
        server.shutdown()
        thread.join()


def deliverer(redis: Redis, allowed: list[str], back_off_s: tuple[float, ...] = (0.0, 0.0)) -> Deliverer:
    hosts = AllowList(allowed)
    secrets = read_secrets([f"alice:{SECRET}"], None)
    store, outbox = RedisRecordStore(redis), RedisOutbox(redis)
    return Deliverer(store, outbox, HttpSender(hosts.permits), hosts, secrets, back_off_s)


def finish(redis: Redis, url: str, status: str = "successful", name: str = "j1") -> JobRecord:
    """A job of alice's with a webhook, ended."""
    store = RedisRecordStore(redis)
    request = {"scene": reference_of("alice", "a" * 64), "webhook": {"url": url}}
    now = store.now()
    record, _ = store.create_job(JobRecord(name, "registration", "accepted", request, {}, now, now), 10)
    error = {"reason": "NO_SURFACE_IN_DETECTION", "detail": "text"} if status == "failed" else None
    store.update_job(name, record.attempt, status="running")
    return store.update_job(name, record.attempt, status=status, error=error)


def delivery(redis: Redis, place: int = 0, name: str = "j1") -> Delivery:
    """How the message to one of the job's webhooks fares."""
    record = RedisRecordStore(redis).get_job(name)
    assert record is not None
    return RedisOutbox(redis).deliveries(record)[place]


def ask(redis: Redis, url: str, name: str = "j1") -> JobRecord:
    """Another request of alice's for the same job, with a webhook of its own."""
    store = RedisRecordStore(redis)
    request = {"scene": reference_of("alice", "a" * 64), "webhook": {"url": url}}
    now = store.now()
    return store.create_job(JobRecord(name, "registration", "accepted", request, {}, now, now), 10)[0]


# signatures


def test_the_signature_is_that_of_the_specification() -> None:
    body = b'{"event_type":"ping","data":{"success":true}}'
    headers = signed_headers([KEY, b"k" * 64], "msg_1", 1731705121, body)
    expected = [hmac_by_hand(key, b"msg_1.1731705121." + body) for key in (KEY, b"k" * 64)]
    assert [base64.b64decode(one.removeprefix("v1,")) for one in headers["webhook-signature"].split(" ")] == expected
    assert (headers["webhook-id"], headers["webhook-timestamp"]) == ("msg_1", "1731705121")


NO_SECRETS = ["", SECRET, "alice:", "alice:whsec_", "alice:whsec_AAAA", f"Alice:{SECRET}", f"alice:{SECRET}!",
              "alice:whsec_" + "A" * 92, "alice:" + SECRET[6:]]  # fmt: skip


@pytest.mark.parametrize("entry", NO_SECRETS)
def test_secrets_that_are_none_are_refused_without_repeating_them(entry: str) -> None:
    with pytest.raises(TokensError) as refused:
        read_secrets([entry], None)
    assert SECRET[6:] not in str(refused.value)


# where to


def test_a_name_that_resolves_to_a_private_address_is_not_followed(redis: Redis, receiver: Receiver) -> None:
    named = receiver.address.replace("127.0.0.1", "localhost")
    finish(redis, f"{named}/x")
    assert deliverer(redis, [named]).run_once()
    assert (receiver.received, delivery(redis).last_error) == ([], "ADDRESS_NOT_ALLOWED")
    # the list names the address itself, though with another port: then it is followed there
    assert deliverer(redis, [named, "127.0.0.1", "[::1]"]).run_once()
    assert delivery(redis).state == "delivered"


# what arrives


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_a_message_arrives_signed(redis: Redis, receiver: Receiver, status: str) -> None:
    record = finish(redis, f"{receiver.address}/hook?x=1", status)
    sent = deliverer(redis, [receiver.address])
    assert (sent.run_once(), sent.run_once()) == (True, False)
    (path, headers, body) = receiver.received[0]
    assert (path, headers["content-type"], len(receiver.received)) == ("/hook?x=1", "application/json", 1)
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    assert headers["webhook-signature"] == "v1," + base64.b64encode(hmac_by_hand(KEY, signed)).decode()
    assert abs(int(headers["webhook-timestamp"]) - RedisRecordStore(redis).now()) < 60
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
        now = RedisRecordStore(redis).now()
        assert sent.run_once()
        found = delivery(redis)
        assert (found.state, found.sends, found.next_at is not None) == ("pending", sends, True)
        assert found.next_at == pytest.approx(now + pause, abs=20)
        assert not sent.run_once(), "not before its time"
        redis.zadd("regnf:webhooks:due", {"j1-1-0": 0})
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


# that none is lost


def test_a_message_outlives_who_took_it(redis: Redis, receiver: Receiver) -> None:
    """A process that dies after it took a message: another sends it once a minute is over, not before."""
    finish(redis, receiver.address)
    assert RedisOutbox(redis).claim() == Message("j1", 1, 0)
    assert not deliverer(redis, [receiver.address]).run_once()
    score = float(redis.zscore("regnf:webhooks:due", "j1-1-0"))  # type: ignore[arg-type]
    assert score == pytest.approx(RedisRecordStore(redis).now() + 60, abs=20)
    redis.zadd("regnf:webhooks:due", {"j1-1-0": 0})
    assert deliverer(redis, [receiver.address]).run_once()
    assert len(receiver.received) == 1


def test_many_deliverers_send_each_message_once(redis: Redis, redis_url: str, receiver: Receiver) -> None:
    for number in range(12):
        finish(redis, receiver.address, name=f"job{number}")

    @contextmanager
    def one() -> Iterator[Deliverer]:
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
    store, outbox = RedisRecordStore(redis), RedisOutbox(redis)
    finish(redis, receiver.address, "failed")
    record = store.get_job("j1")
    assert record is not None
    again, _ = store.create_job(record, 10)
    assert (again.attempt, outbox.waiting(), delivery(redis).state) == (2, 0, "waiting")
    store.update_job("j1", 2, status="dismissed")
    assert (outbox.waiting(), delivery(redis).state) == (1, "pending")
    store.delete_job("j1")
    assert (outbox.waiting(), redis.exists("regnf:webhook:j1:0")) == (0, 0)
    redis.zadd("regnf:webhooks:due", {"gone-1-0": 0})
    assert deliverer(redis, [receiver.address]).run_once()
    assert (receiver.received, outbox.waiting()) == ([], 0)


# several requests for one job


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
    store = RedisRecordStore(redis)
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
    store, outbox = RedisRecordStore(redis), RedisOutbox(redis)
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
