"""The calls to a regnf service: register one box or one object in an image, wait for the end, fetch the result.

httpx alone, no ROS.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import httpx

from regnf_ros.images import CameraImage

ACTIVE = ("accepted", "running")
HELD_S = 20
"""How long the service may hold an answer; the client waits longer."""

IN_USE = "FIELD_IN_USE"
"""The reason of a refusal: a job still needs an image."""


class ServiceError(RuntimeError):
    """The service refused or failed; ``reason`` is its stable word."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


@dataclass(frozen=True)
class Request:
    """What is asked: a scene and an object's field by its SHA-256, a detection, options.

    scene: the SHA-256 of a field, or an image that is sent along.
    """

    scene: str | CameraImage
    object: str
    detection: dict[str, Any]
    options: dict[str, Any]


class Service:
    """One service. ``transport``: for tests."""

    def __init__(self, address: str, token: str = "", transport: httpx.BaseTransport | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._sent: set[str] = set()
        self._http = httpx.Client(base_url=address, headers=headers, timeout=2 * HELD_S, transport=transport)

    def register(self, request: Request) -> dict[str, Any]:
        """The result document. Raises ServiceError, also where the service cannot be reached.

        A picture of the result is made where there is a color image for it. The service keeps an image that was sent
        until ``forget``.
        """
        asked = {"object": request.object, "detection": request.detection, "options": request.options}
        how: dict[str, Any]
        if isinstance(request.scene, str):
            how = {"json": {"scene": request.scene} | asked}
        else:
            pictures = request.scene.color is not None
            how = {"files": _parts(request.scene, asked | {"pictures": pictures})}
        job = self._call("POST", "/register", headers={"Prefer": f"wait={HELD_S}"}, **how)
        if "files" in how and (held := job.get("inputs", {}).get("scene")):
            self._sent.add(held)
        while job["status"] in ACTIVE:
            job = self._call("GET", f"/jobs/{job['id']}", params={"wait": str(HELD_S)})
        if job["status"] != "successful":
            error = job.get("error") or {}
            raise ServiceError(error.get("reason", job["status"].upper()), error.get("detail", "the job has no result"))
        return self._call("GET", f"/jobs/{job['id']}/result")

    def forget(self) -> None:
        """The service drops the images that were sent, all but those that it still needs: those go the next time."""
        for scene in sorted(self._sent):
            try:
                self._call("DELETE", f"/recordings/{scene}")
            except ServiceError as error:
                if error.reason == IN_USE:
                    continue
            self._sent.remove(scene)

    def bounds(self, field: str) -> list[list[float]] | None:
        """The lowest and highest corner of a field's surface; None where they are not known. Raises ServiceError."""
        report = self._call("GET", f"/fields/{field}").get("report") or {}
        found: list[list[float]] | None = report.get("surface_bounds")
        return found

    def close(self) -> None:
        self._http.close()

    def _call(self, method: str, path: str, **how: Any) -> dict[str, Any]:
        try:
            answer = self._http.request(method, path, **how)
        except httpx.TransportError as error:
            raise ServiceError("SERVICE_UNREACHABLE", str(error)) from error
        if answer.status_code == httpx.codes.NO_CONTENT:
            return {}
        try:
            document: dict[str, Any] = answer.json()
        except ValueError as error:
            raise ServiceError("ANSWER_UNREADABLE", f"{answer.status_code} without JSON") from error
        if answer.is_error:
            raise ServiceError(document.get("reason", str(answer.status_code)), document.get("detail", ""))
        return document


def _parts(image: CameraImage, asked: dict[str, Any]) -> dict[str, tuple[str, bytes, str]]:
    """The parts of a one-shot request with an image."""
    parts = {
        "depth": ("depth.png", image.depth, "image/png"),
        "camera": ("camera.json", json.dumps(image.camera, allow_nan=False).encode(), "application/json"),
        "request": ("request.json", json.dumps(asked, allow_nan=False).encode(), "application/json"),
    }
    return parts if image.color is None else parts | {"color": ("color.png", image.color, "image/png")}
