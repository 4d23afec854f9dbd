"""Lists of what the service holds, page by page, and what is to be forgotten."""

from __future__ import annotations

from typing import Any

from regnf_client.answers import checked, parsed, refusal
from regnf_client.fields import Asking, FieldLike, find
from regnf_client.models import Field, Job
from regnf_client.steps import Flow, call

_PAGE = 200


def list_fields(asking: Asking, label: str | None) -> Flow[list[Field]]:
    """All fields, newest first."""
    return [parsed(Field, one) for one in (yield from pages(asking, "fields", {"label": label}))]


def list_jobs(asking: Asking, status: str | None) -> Flow[list[Job]]:
    """All jobs, newest first."""
    return [parsed(Job, one) for one in (yield from pages(asking, "jobs", {"status": status}))]


def delete_field(asking: Asking, field: FieldLike) -> Flow[None]:
    """Forget a field. Raises ServiceError (FIELD_NOT_FOUND, FIELD_IN_USE)."""
    known = yield from find(asking, field)
    answer = yield from call(asking.patience, "DELETE", f"/fields/{known.sha256}")
    if not answer.is_success:
        raise refusal(answer)


def pages(asking: Asking, what: str, chosen: dict[str, str | None]) -> Flow[list[dict[str, Any]]]:
    """Every entry of every page: a page may be short or empty and not be the last."""
    params: dict[str, Any] = {name: value for name, value in chosen.items() if value is not None} | {"limit": _PAGE}
    found: list[dict[str, Any]] = []
    while True:
        page = checked((yield from call(asking.patience, "GET", f"/{what}", params=params)))
        found += page[what if what in page else "entries"]
        if page["next_page_token"] is None:
            return found
        params = params | {"page_token": page["next_page_token"]}
