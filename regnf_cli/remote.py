"""A client of a regnf service: upload what it lacks, post, follow, fetch."""

from __future__ import annotations

import hashlib
import io
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx

from regnf_client import answers
from regnf_client.answers import ServiceError, UnreachableError, checked_address
from regnf_client.steps import Patience, WorkerWatch, worker_lives
from regnf_core.field_source import FieldSource
from regnf_core.importing.upload_description import UploadDescription

# An HTTP client that obeys a service which says that it is asked too fast, or that a file is still to come.


class PatientClient(httpx.Client):
    """Asks again after the seconds of `Retry-After`, for two minutes at most; then the refusal is the answer.

    Up to twice the seconds, so that many that were refused together do not ask together ever after. The body of a
    request must be one that can be sent again.
    """

    def __init__(self, *, sleep: Callable[[float], None] = time.sleep, **options: Any) -> None:
        super().__init__(**options)
        self._sleep = sleep

    def send(self, request: httpx.Request, **how: Any) -> httpx.Response:
        """The answer that is no such refusal, or the last one."""
        tries = Patience(retries=0).tries()
        while True:
            answer = super().send(request, **how)
            if answer.is_error:
                answer.read()
            wait_s = tries.wait_s(answer)
            if wait_s is None:
                return answer
            self._sleep(wait_s)


# What a service answers when it refuses, in the words of the command line.

_HINTS = {
    "UNAUTHENTICATED": "Give the service's token with --token, or in the environment variable REGNF_API_TOKEN.",
    "RATE_LIMITED": "Wait a moment, and give the same command again.",
    "TOO_MANY_WRITES": "Wait a moment, and give the same command again.",
    "QUEUE_FULL": "Give the same command again later.",
}


def checked(response: httpx.Response) -> dict[str, Any]:
    """The JSON object of a good answer; raises ServiceError for a refusal, and for what is no regnf service."""
    return answers.checked(response, _HINTS)


def service_error(problem: dict[str, Any]) -> ServiceError:
    """The error for a problem object."""
    return answers.service_error(problem, _HINTS)


def unreachable(address: str, error: httpx.RequestError) -> UnreachableError:
    """The error for a service that does not answer."""
    hint = "Is it running? `regnf serve` starts one and prints its address; without --server the work is done here."
    return UnreachableError(f"{address} does not answer: {error}", hint=hint)


_BLOCK = 1 << 20
_FINISHED = ("successful", "failed", "dismissed")
_POLL_S = 2
WORKER_TIMEOUT_S = 60
Report = Callable[[str, float], None]
"""Called with a phase and a share 0..1."""


class RemoteService:
    """The few calls of the HTTP contract that a registration needs.

    What is asked too fast is asked again when the service says so.
    What waits for a worker raises NoWorkerError once the service has had none for ``worker_timeout_s``.
    """

    def __init__(self, address: str, token: str | None = None, worker_timeout_s: float = WORKER_TIMEOUT_S) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        checked_address(address)
        self.address = address.rstrip("/")
        self._http = PatientClient(base_url=self.address, headers=headers, timeout=httpx.Timeout(60.0, connect=5.0))
        self._watch = WorkerWatch(worker_timeout_s)

    def __enter__(self) -> RemoteService:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def _look_for_worker(self) -> None:
        """Raises NoWorkerError once the service has had none for too long."""
        if not self._watch.due:
            return
        try:
            readiness = self._http.get("/readyz").json()
        except ValueError:
            readiness = None
        self._watch.saw(worker_lives(readiness))

    def upload_field(self, field: FieldSource | Path, report: Report = lambda phase, share: None) -> str:
        """Send a field unless the service holds it; returns its SHA-256 once the service has found it good."""
        sha256 = self.send(field, report)
        self.wait_until_ready(sha256)
        return sha256

    def send(self, field: FieldSource | Path, report: Report = lambda phase, share: None) -> str:
        """Send a field unless the service holds it; returns its SHA-256 while its import may still run.

        Raises ServiceError FIELD_DESCRIPTION_DIFFERS for bytes that are held as another function.
        """
        source = field if isinstance(field, FieldSource) else FieldSource(field, field)
        sha256 = _sha256(source.file)
        known = self._http.get(f"/fields/{sha256}")
        with source.packed_settings() as settings:
            if known.status_code != 200 or checked(known).get("state") == "rejected":
                self._send(source, settings, report)
                return sha256
            if source.said or settings is not None:
                _require_same(checked(known), source, settings)
        self._name(sha256, checked(known).get("label"), source)
        return sha256

    def _name(self, sha256: str, held: str | None, source: FieldSource) -> None:
        """Call a field that the service holds as the user now does, or by the file's name where it has none.

        What refuses a name takes the registration nevertheless.
        """
        if source.label and held != source.label and (held is None or "label" in source.said):
            self._http.patch(f"/fields/{sha256}", json={"label": source.label})

    def _send(self, source: FieldSource, settings: Path | None, report: Report) -> None:
        """The bytes, what is said of them, and their settings."""
        with _Told(source.file, report) as file:
            parts: dict[str, Any] = {
                "description": (None, json.dumps(source.description_to_send), "application/json"),
                "file": (source.file.name, file, "application/octet-stream"),
            }
            if settings is not None:
                parts["settings"] = (settings.name, settings.read_bytes(), "application/octet-stream")
            checked(self._http.post("/fields", files=parts))

    def wait_until_ready(self, sha256: str) -> None:
        """Wait for a field's import to end; raises ServiceError with the gate's reason when it was rejected."""
        while True:
            document = checked(self._http.get(f"/fields/{sha256}", params={"wait": _POLL_S}))
            if document["state"] == "ready":
                return
            if document["state"] == "rejected":
                raise service_error(document.get("error") or {})
            self._look_for_worker()

    def library(self) -> Iterator[dict[str, Any]]:
        """The entries of the caller's library."""
        token: str | None = None
        while True:
            params = {"limit": "200"} | ({} if token is None else {"page_token": token})
            page = checked(self._http.get("/library", params=params))
            yield from page["entries"]
            token = page["next_page_token"]
            if token is None:
                return

    def submit(self, request: dict[str, Any]) -> dict[str, Any]:
        """POST /register; returns the job document."""
        return checked(self._http.post("/register", json=request))

    def follow(self, job_id: str, report: Report = lambda phase, share: None) -> dict[str, Any]:
        """Poll a job until it has finished; returns its last document."""
        while True:
            job = checked(self._http.get(f"/jobs/{job_id}"))
            report(job.get("phase") or job["status"], job.get("progress") or 0.0)
            if job["status"] in _FINISHED:
                return job
            self._look_for_worker()
            checked(self._http.get(f"/jobs/{job_id}", params={"wait": 1}))

    def cancel(self, job_id: str) -> None:
        """Stop a job; no error if it was stopped before."""
        checked(self._http.post(f"/jobs/{job_id}/cancel"))

    def page(self, job_id: str) -> str:
        """The address of a job's page."""
        return f"{self.address}/jobs/{job_id}/view"

    def result(self, job_id: str) -> dict[str, Any]:
        """The result document of a successful job; raises ServiceError with the job's own reason otherwise."""
        return checked(self._http.get(f"/jobs/{job_id}/result"))

    def fetch_artifact(self, job_id: str, name: str, target: Path) -> None:
        """Download one artifact to a file."""
        with self._http.stream("GET", f"/jobs/{job_id}/artifacts/{name}") as response:
            if response.status_code != 200:
                response.read()
                checked(response)
            with target.open("wb") as file:
                for block in response.iter_bytes(_BLOCK):
                    file.write(block)


class _Told(io.FileIO):
    """A file that tells how much of it was read."""

    def __init__(self, path: Path, report: Report) -> None:
        super().__init__(path, "rb")
        self.size = path.stat().st_size
        self._report = report

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes."""
        block = super().read(-1 if size is None else size) or b""
        self._report("uploading", self.tell() / max(self.size, 1))
        return block


def _require_same(held: dict[str, Any], source: FieldSource, settings: Path | None) -> None:
    """Raises ServiceError FIELD_DESCRIPTION_DIFFERS unless the service has the field as the user wants it.

    What it will be used as is no condition, as long as the user has not said it.
    """
    said = UploadDescription.from_dict(dict(source.said)).non_default()
    wanted = {name: value for name, value in said.items() if name != "label"}
    found = {name: value for name, value in (held.get("description") or {}).items() if name in wanted or name != "as"}
    digest = None if settings is None else _sha256(settings)
    if (wanted, digest) != (found, (held.get("settings") or {}).get("sha256")):
        message = "the service holds the same bytes with another description or other settings"
        hint = f"Delete the field there first (DELETE /fields/{held.get('sha256')}), or leave them out."
        raise ServiceError(message, reason="FIELD_DESCRIPTION_DIFFERS", hint=hint)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
