"""One leader at a time, and a leader that was slow hears that it no longer leads."""

import pytest
from redis import Redis

from regnf_service.upkeep.housekeeping import Lease, LeaseLostError


@pytest.fixture
def lease(redis: Redis) -> Lease:
    redis.flushall()
    return Lease(redis, "lease", 30.0)


def test_one_leader_at_a_time(lease: Lease) -> None:
    with lease.held() as first, lease.held() as second:
        assert first is not None
        assert second is None
        first.confirm()
    with lease.held() as third:
        assert third is not None
        assert third.number > first.number


def test_a_leader_whose_term_has_lapsed_is_told(lease: Lease, redis: Redis) -> None:
    with lease.held() as slow:
        assert slow is not None
        redis.delete("lease")
        with lease.held() as next_:
            assert next_ is not None
            with pytest.raises(LeaseLostError):
                slow.confirm()
            next_.confirm()
    assert not redis.exists("lease")


def test_the_end_of_an_old_term_does_not_end_the_new_one(lease: Lease, redis: Redis) -> None:
    with lease.held():
        redis.set("lease", "999")
    assert redis.get("lease") == b"999"


def test_a_confirmed_term_goes_on(lease: Lease, redis: Redis) -> None:
    with lease.held() as term:
        assert term is not None
        redis.pexpire("lease", 1000)
        term.confirm()
        left = redis.pttl("lease")
        assert isinstance(left, int)
        assert left > 20_000
