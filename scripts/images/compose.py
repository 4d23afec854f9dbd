"""A compose file as compose renders it: variables replaced everywhere, also in services that will not be started."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from scripts.images.interpolation import interpolated

Service = dict[str, Any]


def render(path: Path, variables: Mapping[str, str], profiles: Iterable[str] = ()) -> dict[str, Service]:
    """The services that the profiles start, by name; each one's environment as the names and texts it is given.

    Raises ComposeError.
    """
    document = interpolated(yaml.safe_load(path.read_text(encoding="utf-8")), variables)
    wanted = {*profiles, *filter(None, variables.get("COMPOSE_PROFILES", "").split(","))}
    services: dict[str, Service] = document["services"]
    return {
        name: service | {"environment": _environment(service, variables)}
        for name, service in services.items()
        if not service.get("profiles") or wanted & set(service["profiles"])
    }


def _environment(service: Service, variables: Mapping[str, str]) -> dict[str, str]:
    """A name without a value takes the caller's; one that the caller lacks is not set."""
    given: dict[str, str | int | None] = service.get("environment", {})
    handed_on = {name: variables.get(name) if value is None else str(value) for name, value in given.items()}
    return {name: value for name, value in handed_on.items() if value is not None}
