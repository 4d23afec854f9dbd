"""A client of a regnf service: upload what it lacks, post, follow, fetch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx

from regnf_cli.remote_errors import checked, checked_address, service_error
from regnf_cli.worker_watch import WorkerWatch

_BLOCK = 1 << 20
_FINISHED = ("successful", "failed", "dismissed")
_POLL_S = 2
WORKER_TIMEOUT_S = 60
Report = Callable[[str, float], None]
"""Called with a phase and a share 0..1."""


class RemoteService:
    """The few calls of the HTTP contract that a registration needs.

    What waits for a worker raises NoWorkerError once the service has had none for ``worker_timeout_s``.
    """

    def __init__(self, address: str, token: str | None = None, worker_timeout_s: float = WORKER_TIMEOUT_S) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        checked_address(address)
        self.address = address.rstrip("/")
        self._http = httpx.Client(base_url=self.address, headers=headers, timeout=httpx.Timeout(60.0, connect=5.0))
        self._watch = WorkerWatch(self._worker_lives, worker_timeout_s)

    def __enter__(self) -> RemoteService:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def _worker_lives(self) -> bool:
        """As far as the service says; one that says nothing of it is taken to have one."""
        try:
            checks = self._http.get("/readyz").json()["checks"]
            return checks["worker"] is not False
        except (KeyError, TypeError, ValueError):
            return True

    def upload_field(self, path: Path, report: Report = lambda phase, share: None) -> str:
        """Send a field unless the service holds it; returns its SHA-256 once the service has found it good."""
        sha256 = self.send(path, report)
        self.wait_until_ready(sha256)
        return sha256

    def send(self, path: Path, report: Report = lambda phase, share: None) -> str:
        """Send a field unless the service holds it; returns its SHA-256 while its import may still run."""
        sha256 = _sha256(path)
        known = self._http.get(f"/fields/{sha256}")
        if known.status_code != 200 or checked(known).get("state") == "rejected":
            size = max(path.stat().st_size, 1)

            def body() -> Iterator[bytes]:
                sent = 0
                with path.open("rb") as file:
                    while block := file.read(_BLOCK):
                        yield block
                        sent += len(block)
                        report("uploading", sent / size)

            length = {"Content-Length": str(path.stat().st_size), "Content-Type": "application/octet-stream"}
            checked(self._http.put(f"/fields/{sha256}", content=body(), headers=length))
        return sha256

    def wait_until_ready(self, sha256: str) -> None:
        """Wait for a field's import to end; raises ServiceError with the gate's reason when it was rejected."""
        while True:
            document = checked(self._http.get(f"/fields/{sha256}", params={"wait": _POLL_S}))
            if document["state"] == "ready":
                return
            if document["state"] == "rejected":
                raise service_error(document.get("error") or {})
            self._watch.look()

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
            self._watch.look()
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


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
