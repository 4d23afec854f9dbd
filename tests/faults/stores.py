"""What lies in the storage, looked at past the service."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import obstore
from obstore.store import S3Store

from regnf_state.blobs.object_store import object_client
from tests.listing import files_below
from tests.object_store import ObjectServer, environment

_TEMPORARY = ".tmp/"
_MAX_WAIT_S = 30.0


class Store(Protocol):
    """One storage: the settings that name it, its keys, unfinished ones too, and their bytes."""

    @property
    def environment(self) -> dict[str, str]: ...

    def listing(self) -> list[str]: ...

    def read(self, key: str) -> bytes: ...


@dataclass(frozen=True)
class Folder:
    """The local folder that all processes share."""

    state: Path

    @property
    def root(self) -> Path:
        return self.state / "blobs"

    @property
    def environment(self) -> dict[str, str]:
        return {}

    def listing(self) -> list[str]:
        return sorted(path.relative_to(self.root).as_posix() for path in files_below(self.root))

    def read(self, key: str) -> bytes:
        return (self.root / key).read_bytes()


@dataclass(frozen=True)
class Bucket:
    """A bucket of an object store that processes reach at ``endpoint``, and tests directly."""

    server: ObjectServer
    name: str
    endpoint: str

    @property
    def environment(self) -> dict[str, str]:
        return self.server.environment | {
            "AWS_ENDPOINT_URL": self.endpoint,
            "REGNF_STORAGE_URL": f"s3://{self.name}/service",
        }

    @cached_property
    def _client(self) -> S3Store:
        with environment(self.server.environment):
            return object_client(f"s3://{self.name}/service", _MAX_WAIT_S, _MAX_WAIT_S)

    def listing(self) -> list[str]:
        found = [entry["path"] for page in obstore.list(self._client) for entry in page]
        return sorted(found) + [f"{_TEMPORARY}upload"] * self.server.unfinished_uploads(self.name)

    def read(self, key: str) -> bytes:
        return bytes(obstore.get(self._client, key).bytes())


def left_unfinished(store: Store) -> list[str]:
    """Keys of writers that have not finished; a probe's is no leftover, it is always the same one."""
    return [key for key in store.listing() if key.startswith(_TEMPORARY) and key != f"{_TEMPORARY}probe"]
