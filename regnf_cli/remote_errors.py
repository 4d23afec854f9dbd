"""What a service answers when it refuses, in the words of the command line."""

from __future__ import annotations

from typing import Any

import httpx

from regnf_client import answers
from regnf_client.errors import ServiceError, UnreachableError

_HINTS = {
    "UNAUTHENTICATED": "Give the service's token with --token, or in the environment variable REGNF_API_TOKEN.",
    "RATE_LIMITED": "Wait a moment, and give the same command again.",
    "TOO_MANY_WRITES": "Wait a moment, and give the same command again.",
    "QUEUE_FULL": "Give the same command again later.",
}


def checked(response: httpx.Response) -> dict[str, Any]:
    """The JSON object of a good answer; raises ServiceError for a refusal, and for what is no regnf service."""
    return answers.checked(response, _HINTS)


def service_error(problem: dict[str, Any]) -> ServiceError:
    """The error for a problem object."""
    return answers.service_error(problem, _HINTS)


def unreachable(address: str, error: httpx.RequestError) -> UnreachableError:
    """The error for a service that does not answer."""
    hint = "Is it running? `regnf serve` starts one and prints its address; without --server the work is done here."
    return UnreachableError(f"{address} does not answer: {error}", hint=hint)
