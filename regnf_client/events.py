"""A job's server-sent events: lines become events."""

from __future__ import annotations

import json

from regnf_client.models import Event

TERMINAL = frozenset({"successful", "failed", "dismissed"})


class EventReader:
    """Takes a stream's lines; of each blank line an event may come. Knows where a new connection would go on."""

    def __init__(self) -> None:
        self.last_id: str | None = None
        self.ended = False
        """Whether the job's end has come."""
        self._lines: dict[str, str] = {}

    def headers(self) -> dict[str, str]:
        """Of the next connection."""
        return {"Accept": "text/event-stream"} | ({} if self.last_id is None else {"Last-Event-ID": self.last_id})

    def connected(self) -> None:
        """A new connection begins; half an event of the one before is forgotten."""
        self._lines = {}

    def take(self, line: str) -> Event | None:
        """The event that ends with this line, if one does."""
        if line:
            name, _, value = line.partition(":")
            self._lines[name] = value.removeprefix(" ")
            return None
        lines, self._lines = self._lines, {}
        if "data" not in lines:
            return None
        event = Event(id=lines.get("id", ""), name=lines.get("event", "message"), data=json.loads(lines["data"]))
        self.last_id = event.id or self.last_id
        self.ended = event.data.get("status") in TERMINAL
        return event
