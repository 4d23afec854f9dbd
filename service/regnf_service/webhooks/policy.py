"""What the service knows of webhooks when a request names one: who may, to where, and how its message fares."""

from __future__ import annotations

from dataclasses import dataclass

from regnf_service.problem import Problem
from regnf_service.webhooks.signing import Secrets
from regnf_service.webhooks.targets import AllowList
from regnf_state.records import JobRecord
from regnf_state.redis.webhook_outbox import Delivery, RedisOutbox

_POINTER = "/webhook/url"


@dataclass(frozen=True)
class Webhooks:
    """The hosts that are allowed, the callers' keys, and the outbox."""

    allowed: AllowList
    secrets: Secrets
    outbox: RedisOutbox

    def check(self, caller: str, url: str | None) -> None:
        """Whether this caller may name this address. Raises Problem WEBHOOK_NOT_ALLOWED."""
        if url is None:
            return
        if not self.allowed.allows(url):
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[{"pointer": _POINTER, "detail": "no host that is allowed"}])
        if caller not in self.secrets:
            fault = {"pointer": _POINTER, "detail": "the service has no secret of yours to sign with"}
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[fault])

    def deliveries(self, record: JobRecord) -> list[Delivery]:
        """The state of the message to each of the job's webhooks."""
        return self.outbox.deliveries(record)
