"""Jobs: asked for, waited for, their results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import uuid4

from regnf_client.answers import checked, parsed
from regnf_client.fields import Asking
from regnf_client.models import Job, Rendering, Result
from regnf_client.steps import Flow, call
from regnf_client.worker_watch import look
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
