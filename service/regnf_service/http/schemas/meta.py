"""What the service says about itself."""

from __future__ import annotations

from typing import Any, Literal

from regnf_service.http.schemas.common import Outgoing


class HealthDocument(Outgoing):
    """The process answers."""

    status: Literal["ok"]


class ReadyDocument(Outgoing):
    """Every part the service needs is there."""

    status: Literal["ready"]
    checks: dict[str, bool]


class VersionDocument(Outgoing):
    """What runs here."""

    name: Literal["regnf"]
    version: str
    python: str


class IndexDocument(Outgoing):
    """Every address, each with what it is for."""

    name: Literal["regnf"]
    version: str
    addresses: dict[str, str]


class DemoFile(Outgoing):
    """A field file to fetch and to upload."""

    name: str
    bytes: int
    address: str


class DemoDocument(Outgoing):
    """A scene and an object to try, and a detection as `POST /register` takes it."""

    scene: DemoFile
    object: DemoFile
    detection: dict[str, Any]
