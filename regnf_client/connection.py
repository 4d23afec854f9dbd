"""What both clients are made of: address, token, patience."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import httpx

from regnf_client.errors import checked_address, checked_token
from regnf_client.fields import Asking, Report
from regnf_client.patience import Patience
from regnf_client.worker_watch import WorkerWatch

ADDRESS = "http://127.0.0.1:8080"
WORKER_TIMEOUT_S = 60.0
_AROUND = "\ufeff \t\r\n"
"""What a shell keeps of a file that Windows wrote."""
_TIMEOUT = httpx.Timeout(60.0, connect=5.0)


@dataclass(frozen=True)
class Connection:
    """Address, token and manners of a client."""

    address: str
    token: str | None
    retries: int
    worker_timeout_s: float | None

    def http_options(self) -> dict[str, Any]:
        """Of httpx's clients. Raises InvalidInputError (INVALID_ADDRESS, INVALID_TOKEN)."""
        checked_address(self.address)
        token = self.token if self.token is not None else os.environ.get("REGNF_API_TOKEN")
        headers = {"Authorization": f"Bearer {checked_token(token.strip(_AROUND))}"} if token else {}
        return {"base_url": self.address.rstrip("/"), "headers": headers, "timeout": _TIMEOUT}

    def asking(self, report: Report | None = None, timeout_s: float | None = None) -> Asking:
        """For one call of a method."""
        return Asking(Patience(retries=self.retries), WorkerWatch(self.worker_timeout_s), report, timeout_s)
