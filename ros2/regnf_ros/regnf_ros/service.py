"""The calls to a regnf service: register one box, wait for its end, fetch the result. httpx alone, no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import httpx

ACTIVE = ("accepted", "running")
HELD_S = 20
"""How long the service may hold an answer; the client waits longer."""


class ServiceError(RuntimeError):
    """The service refused or failed; ``reason`` is its stable word."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


@dataclass(frozen=True)
class Request:
    """What is asked: a scene's and an object's field by their SHA-256, a detection, options."""

    scene: str
    object: str
    detection: dict[str, Any]
    options: dict[str, Any]


class Service:
    """One service. ``transport``: for tests."""

    def __init__(self, address: str, token: str = "", transport: httpx.BaseTransport | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=address, headers=headers, timeout=2 * HELD_S, transport=transport)

    def register(self, request: Request) -> dict[str, Any]:
        """The result document. Raises ServiceError, also where the service cannot be reached."""
        body = {
            "scene": request.scene,
            "object": request.object,
            "detection": request.detection,
            "options": request.options,
        }
        job = self._call("POST", "/register", json=body, headers={"Prefer": f"wait={HELD_S}"})
        while job["status"] in ACTIVE:
            job = self._call("GET", f"/jobs/{job['id']}", params={"wait": str(HELD_S)})
        if job["status"] != "successful":
            error = job.get("error") or {}
            raise ServiceError(error.get("reason", job["status"].upper()), error.get("detail", "the job has no result"))
        return self._call("GET", f"/jobs/{job['id']}/result")

    def close(self) -> None:
        self._http.close()

    def _call(self, method: str, path: str, **how: Any) -> dict[str, Any]:
        try:
            answer = self._http.request(method, path, **how)
        except httpx.TransportError as error:
            raise ServiceError("SERVICE_UNREACHABLE", str(error)) from error
        try:
            document: dict[str, Any] = answer.json()
        except ValueError as error:
            raise ServiceError("ANSWER_UNREADABLE", f"{answer.status_code} without JSON") from error
        if answer.is_error:
            raise ServiceError(document.get("reason", str(answer.status_code)), document.get("detail", ""))
        return document
