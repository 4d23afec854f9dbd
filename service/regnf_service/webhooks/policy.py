"""What the service knows of webhooks when a request names one: who may, to where, and how its message fares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from regnf_service.http.problems import Problem
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

    def check(self, caller: str, request: Mapping[str, Any]) -> None:
        """Raises Problem WEBHOOK_NOT_ALLOWED."""
        if "webhook" not in request:
            return
        if not self.allowed.allows(request["webhook"]["url"]):
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[{"pointer": _POINTER, "detail": "no host that is allowed"}])
        if caller not in self.secrets:
            fault = {"pointer": _POINTER, "detail": "the service has no secret of yours to sign with"}
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[fault])

    def deliveries(self, record: JobRecord) -> list[Delivery]:
        """How the message to each of the job's webhooks fares."""
        return self.outbox.deliveries(record)
