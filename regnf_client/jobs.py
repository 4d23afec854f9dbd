"""Jobs: asked for, waited for, their results."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote
from uuid import uuid4

from regnf_client.answers import ServiceError, checked, parsed, refusal
from regnf_client.fields import Asking, FieldLike
from regnf_client.fields import find as find_field
from regnf_client.models import Field, Job, Rendering, Result
from regnf_client.steps import Download, Flow, again, call, look, work
from regnf_core.errors import InvalidInputError

JobLike = str | Job | Result | Rendering
"""A job, its id, or what came of it."""


def id_of(job: JobLike) -> str:
    """The id of a job. Raises InvalidInputError (INVALID_JOB)."""
    if isinstance(job, Job):
        return job.id
    name = job if isinstance(job, str) else getattr(job, "job", None)
    if isinstance(name, str) and name and all(part.isalnum() or part in "-_" for part in name):
        return name
    hint = "Give what `submit` returned, or its `id`."
    raise InvalidInputError(f"{job!r} names no job", reason="INVALID_JOB", hint=hint)


def submit(asking: Asking, address: str, body: Mapping[str, Any]) -> Flow[Job]:
    """The job of a request. One that is sent again, because an answer was lost, starts nothing anew."""
    headers = {"Idempotency-Key": uuid4().hex}
    answer = yield from call(asking.patience, "POST", address, json=dict(body), headers=headers)
    return parsed(Job, checked(answer))


def find(asking: Asking, job: JobLike) -> Flow[Job]:
    """A job as it is now. Raises ServiceError (JOB_NOT_FOUND, JOB_EXPIRED)."""
    return parsed(Job, checked((yield from call(asking.patience, "GET", f"/jobs/{id_of(job)}"))))


def cancel(asking: Asking, job: JobLike) -> Flow[Job]:
    """Stop a job; no error if it was stopped before. Raises ServiceError (JOB_FINISHED)."""
    return parsed(Job, checked((yield from call(asking.patience, "POST", f"/jobs/{id_of(job)}/cancel"))))


def wait(asking: Asking, job: JobLike) -> Flow[Job]:
    """The job once it has finished. Raises WaitTimeoutError, NoWorkerError."""
    address, etag, deadline = f"/jobs/{id_of(job)}", None, asking.deadline()
    while True:
        # who wants no progress is not told of every change: one request lasts for many seconds
        headers: dict[str, str] = {} if etag is None or asking.report is None else {"If-None-Match": etag}
        params = {"wait": deadline.hold_s()}
        answer = yield from call(asking.patience, "GET", address, params=params, headers=headers)
        if answer.status_code != 304:
            found = parsed(Job, checked(answer))
            etag = answer.headers.get("etag")
            asking.tell(found.phase or found.status, found.progress)
            if found.finished:
                return found
        deadline.check(f"the job {id_of(job)}")
        yield from look(asking.watch, asking.patience)


def result(asking: Asking, job: JobLike) -> Flow[Result]:
    """What a registration found. Raises ServiceError with the job's own reason where it failed."""
    answer = yield from call(asking.patience, "GET", f"/jobs/{id_of(job)}/result")
    return parsed(Result, {**checked(answer), "job": id_of(job)})


def rendering(asking: Asking, job: JobLike) -> Flow[Rendering]:
    """What a rendering made. Raises ServiceError with the job's own reason where it failed."""
    answer = yield from call(asking.patience, "GET", f"/jobs/{id_of(job)}/result")
    return parsed(Rendering, {**checked(answer), "job": id_of(job)})


# Files of a result: downloaded, in a second try from where the first one stopped, and compared with their digests.

_PART = ".part"


def artifact_address(job: JobLike, name: str) -> str:
    """Where a file is."""
    return f"/jobs/{id_of(job)}/artifacts/{quote(name, safe='')}"


def artifact(asking: Asking, job: JobLike, name: str) -> Flow[bytes]:
    """The bytes of a file. Raises ServiceError (ARTIFACT_NOT_FOUND ...)."""
    answer = yield from call(asking.patience, "GET", artifact_address(job, name))
    if not answer.is_success:
        raise refusal(answer)
    return answer.content


def download(asking: Asking, job: JobLike, name: str, target: Path, sha256: str | None = None) -> Flow[Path]:
    """Write a file to ``target``, which is there only once it is whole.

    Raises ServiceError: ARTIFACT_NOT_FOUND, DIGEST_MISMATCH for bytes that are not those of ``sha256``.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + _PART)
    part.unlink(missing_ok=True)
    answer = yield from again(asking.patience, Download(artifact_address(job, name), part))
    if not answer.is_success:
        raise refusal(answer)
    if sha256 is not None and (yield from work(partial(_digest, part))) != sha256:
        part.unlink()
        hint = "Download it again; if that does not help, register again."
        raise ServiceError(f"{name}: the bytes that came are not the result's", reason="DIGEST_MISMATCH", hint=hint)
    part.replace(target)
    return target


def save(asking: Asking, found: Result | Rendering, folder: Path) -> Flow[list[Path]]:
    """Write all files of a result into a folder."""
    paths = []
    for number, one in enumerate(found.artifacts):
        asking.tell("downloading", number / len(found.artifacts))
        target = folder / Path(one.name).name  # never outside the folder
        paths.append((yield from download(asking, found.job, one.name, target, one.sha256)))
    asking.tell("downloading", 1.0)
    return paths


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# Lists of what the service holds, page by page, and what is to be forgotten.

_PAGE = 200


def list_fields(asking: Asking, label: str | None) -> Flow[list[Field]]:
    """All fields, newest first."""
    return [parsed(Field, one) for one in (yield from pages(asking, "fields", {"label": label}))]


def list_jobs(asking: Asking, status: str | None) -> Flow[list[Job]]:
    """All jobs, newest first."""
    return [parsed(Job, one) for one in (yield from pages(asking, "jobs", {"status": status}))]


def delete_field(asking: Asking, field: FieldLike) -> Flow[None]:
    """Forget a field. Raises ServiceError (FIELD_NOT_FOUND, FIELD_IN_USE)."""
    known = yield from find_field(asking, field)
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
