"""What goes wrong with a service, each with its ``reason`` and a ``hint``.

RegnfError
├── InvalidInputError      INVALID_ADDRESS, INVALID_TOKEN, FILE_NOT_FOUND ...: refused here, nothing was sent
├── ServiceError           the service refused; ``status`` is that of HTTP
├── UnreachableError       nothing answers, again and again
├── NoWorkerError          no worker takes the job
└── WaitTimeoutError       the time that the caller gave is over; the job goes on
"""

from __future__ import annotations

import re

import httpx

from regnf_core.errors import InvalidInputError, RegnfError
from regnf_core.field_candidates import Candidate, Said

_HOST = re.compile(r"[A-Za-z0-9.-]+(:\d+)?(/.*)?")


class ServiceError(RegnfError):
    """The service refused, or could not do, what was asked; ``reason`` is the one it gave."""

    reason = "SERVICE_ERROR"
    status: int | None = None
    """Of HTTP; None for what was refused before anything was asked."""
    unavailable = False
    """Whether asking again later may help: the service is up but cannot take work now."""
    candidates: tuple[Candidate, ...] = ()
    """What a refused field may be."""
    said: Said | None = None
    """What the user said of that field."""
    offset: int | None = None
    """How many bytes of an upload have arrived."""

    def told(self, message: str) -> ServiceError:
        """The same error in other words."""
        error = ServiceError(message, reason=self.reason, hint=self.hint)
        error.status, error.unavailable = self.status, self.unavailable
        error.candidates, error.said, error.offset = self.candidates, self.said, self.offset
        return error


class UnreachableError(RegnfError):
    """Nothing answers at the service's address."""

    reason = "SERVICE_UNAVAILABLE"
    unavailable = True


class NoWorkerError(RegnfError):
    """The service had no live worker for as long as the caller was ready to wait."""

    reason = "NO_WORKER"
    unavailable = True


class WaitTimeoutError(RegnfError):
    """The job, or the import of a field, has not finished within the time that the caller gave."""

    reason = "WAIT_TIMEOUT"
    unavailable = True


def checked_address(address: str) -> httpx.URL:
    """The address of a service. Raises InvalidInputError (INVALID_ADDRESS)."""
    try:
        url = httpx.URL(address)
    except (httpx.InvalidURL, TypeError) as error:
        message = f"{address}: {error}"
        raise InvalidInputError(message, reason="INVALID_ADDRESS", hint=_address_hint(str(address))) from error
    if url.scheme not in ("http", "https") or not url.host:
        message = f"{address!r} is no http:// or https:// address"
        raise InvalidInputError(message, reason="INVALID_ADDRESS", hint=_address_hint(address))
    return url


def checked_token(token: str) -> str:
    """A token that a header can hold. Raises InvalidInputError (INVALID_TOKEN)."""
    if token.isascii() and token.isprintable() and " " not in token and token:
        return token
    hint = "Give the token alone, as the operator wrote it: without `Bearer`, quotes and line breaks."
    raise InvalidInputError("the token has characters that no token has", reason="INVALID_TOKEN", hint=hint)


def unreachable(error: httpx.RequestError) -> UnreachableError:
    """The error for a service that does not answer."""
    url = error.request.url
    hint = "Is it running? `regnf serve` starts one and prints its address; without a service the work is done here."
    return UnreachableError(f"{url.scheme}://{url.netloc.decode()} does not answer: {error}", hint=hint)


def _address_hint(address: str) -> str:
    if _HOST.fullmatch(address):
        return f"Did you mean http://{address}?"
    return "Write the address that `regnf serve` prints, for example http://127.0.0.1:8080."
