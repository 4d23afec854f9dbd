"""The client of an S3-compatible store, and what its errors mean here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

from obstore.exceptions import BaseError
from obstore.store import S3Store

from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.blobs.retry import MAX_WAIT_S

_CONNECT_TIMEOUT_S = 5.0
_ENDPOINTS = ("AWS_ENDPOINT", "AWS_ENDPOINT_URL")


def object_client(url: str, wait_s: float, timeout_s: float) -> S3Store:
    """A client of the bucket and the prefix in ``url``, which repeats for ``wait_s`` what was certainly not done.

    A request may take ``timeout_s`` seconds. Endpoint and credentials are those of the usual AWS_* variables.
    """
    return S3Store.from_url(
        url,
        client_options={
            "timeout": timedelta(seconds=timeout_s),
            "connect_timeout": timedelta(seconds=_CONNECT_TIMEOUT_S),
            # an endpoint without TLS is used only when it is named so
            "allow_http": any(os.environ.get(name, "").startswith("http://") for name in _ENDPOINTS),
        },
        retry_config={
            "max_retries": 1000,
            "retry_timeout": timedelta(seconds=wait_s),
            "backoff": {
                "init_backoff": timedelta(seconds=0.1),
                "max_backoff": timedelta(seconds=MAX_WAIT_S),
                "base": 2,
            },
        },
    )


@contextmanager
def translate_errors() -> Iterator[None]:
    """Turns the client's errors into OSErrors; FileNotFoundError is one already."""
    try:
        yield
    except BaseError as error:
        raise StorageUnavailableError(f"the object store refuses: {type(error).__name__}") from error
