"""Registration requests as jobs' records hold them."""

from __future__ import annotations

from typing import Any

from regnf_core.detections import Detection
from regnf_core.options import RegistrationOptions
from regnf_state.registration_request import RegistrationRequest


def registration_request(scene: str, object_: str | None, do: str = "succeed", **changes: Any) -> RegistrationRequest:
    """A request whose detection's label tells a tiny engine what to do; the preset asks for no model of the object."""
    usual: dict[str, Any] = {
        "candidates": None,
        "detection": Detection(center=(0.0, 0.0, 0.0), size=(1.0, 1.0, 1.0), label=do),
        "options": RegistrationOptions(preset="paper"),
    }
    return RegistrationRequest(scene, object_, **(usual | changes))


def request_record(scene: str, object_: str | None, do: str = "succeed", **changes: Any) -> dict[str, Any]:
    """The same as a record holds it."""
    return registration_request(scene, object_, do, **changes).to_record()
