"""A caller's library at the service: entries by name, with tags, unit, note and symmetry."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from regnf_client.answers import checked, parsed, refusal
from regnf_client.fields import Asking, FieldLike, upload
from regnf_client.jobs import pages
from regnf_client.models import Entry
from regnf_client.steps import Download, Flow, again, call
from regnf_core.library_entries import EntryNotes, checked_name

_PART = ".part"


def address_of(name: str) -> str:
    """Of an entry. Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
    return f"/library/{quote(checked_name(name), safe='')}"


def add(asking: Asking, field: FieldLike, notes: EntryNotes) -> Flow[Entry]:
    """Upload what the service lacks, and make it an entry. Raises ServiceError (LIBRARY_NAME_TAKEN ...)."""
    sent = yield from upload(asking, field, "object")
    body = notes.to_dict() | {"field": sent.sha256}
    return parsed(Entry, checked((yield from call(asking.patience, "POST", "/library", json=body))))


def entries(asking: Asking, tag: str | None, name: str | None) -> Flow[list[Entry]]:
    """All entries, the one added last first."""
    found = yield from pages(asking, "library", {"tag": tag, "name": name})
    return [parsed(Entry, one) for one in found]


def get(asking: Asking, name: str) -> Flow[Entry]:
    """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
    return parsed(Entry, checked((yield from call(asking.patience, "GET", address_of(name)))))


def change(asking: Asking, name: str, changes: Mapping[str, Any]) -> Flow[Entry]:
    """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND, LIBRARY_NAME_TAKEN)."""
    return parsed(Entry, checked((yield from call(asking.patience, "PATCH", address_of(name), json=dict(changes)))))


def remove(asking: Asking, name: str) -> Flow[None]:
    """Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND)."""
    answer = yield from call(asking.patience, "DELETE", address_of(name))
    if not answer.is_success:
        raise refusal(answer)


def download(asking: Asking, name: str, target: Path) -> Flow[Path]:
    """Write an entry's field, in the safe format. Raises ServiceError (LIBRARY_ENTRY_NOT_FOUND, FIELD_VALIDATING)."""
    part = target.with_name(target.name + _PART)
    part.unlink(missing_ok=True)
    answer = yield from again(asking.patience, Download(f"{address_of(name)}/file", part))
    if not answer.is_success:
        raise refusal(answer)
    part.replace(target)
    return target
