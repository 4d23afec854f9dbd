"""Registration through a regnf service: upload what it lacks, post, follow, fetch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import httpx

from regnf_cli.console import EXIT_UNAVAILABLE, err, fail, phase_progress
from regnf_cli.worker_watch import WorkerWatch
from regnf_core.errors import InvalidInputError, RegnfError

_BLOCK = 1 << 20
_FINISHED = ("successful", "failed", "dismissed")
_POLL_S = 2
WORKER_TIMEOUT_S = 60
Report = Callable[[str, float], None]
"""Called with a phase and a share 0..1."""


class ServiceError(RegnfError):
    """The service refused, or could not do, what was asked; ``reason`` is the one it gave."""

    reason = "SERVICE_ERROR"
    unavailable = False
    """Whether asking again later may help: the service is up but cannot take work now."""


class RemoteService:
    """The few calls of the HTTP contract that a registration needs.

    What waits for a worker raises NoWorkerError once the service has had none for ``worker_timeout_s``.
    """

    def __init__(self, address: str, token: str | None = None, worker_timeout_s: float = WORKER_TIMEOUT_S) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        try:
            url = httpx.URL(address)
        except httpx.InvalidURL as error:
            raise InvalidInputError(f"{address}: {error}", reason="INVALID_ADDRESS") from error
        if url.scheme not in ("http", "https") or not url.host:
            raise InvalidInputError(f"{address!r} is no http:// or https:// address", reason="INVALID_ADDRESS")
        self.address = address
        self._http = httpx.Client(base_url=address, headers=headers, timeout=httpx.Timeout(60.0, connect=5.0))
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
        if known.status_code != 200 or _check(known).get("state") == "rejected":
            size = max(path.stat().st_size, 1)

            def body() -> Iterator[bytes]:
                sent = 0
                with path.open("rb") as file:
                    while block := file.read(_BLOCK):
                        yield block
                        sent += len(block)
                        report("uploading", sent / size)

            length = {"Content-Length": str(path.stat().st_size), "Content-Type": "application/octet-stream"}
            _check(self._http.put(f"/fields/{sha256}", content=body(), headers=length))
        return sha256

    def wait_until_ready(self, sha256: str) -> None:
        """Wait for a field's import to end; raises ServiceError with the gate's reason when it was rejected."""
        while True:
            document = _check(self._http.get(f"/fields/{sha256}", params={"wait": _POLL_S}))
            if document["state"] == "ready":
                return
            if document["state"] == "rejected":
                raise _problem(document.get("error") or {})
            self._watch.look()

    def submit(self, request: dict[str, Any]) -> dict[str, Any]:
        """POST /register; returns the job document."""
        return _check(self._http.post("/register", json=request))

    def follow(self, job_id: str, report: Report = lambda phase, share: None) -> dict[str, Any]:
        """Poll a job until it has finished; returns its last document."""
        while True:
            job = _check(self._http.get(f"/jobs/{job_id}"))
            report(job.get("phase") or job["status"], job.get("progress") or 0.0)
            if job["status"] in _FINISHED:
                return job
            self._watch.look()
            _check(self._http.get(f"/jobs/{job_id}", params={"wait": 1}))

    def result(self, job_id: str) -> dict[str, Any]:
        """The result document of a successful job; raises ServiceError with the job's own reason otherwise."""
        return _check(self._http.get(f"/jobs/{job_id}/result"))

    def fetch_artifact(self, job_id: str, name: str, target: Path) -> None:
        """Download one artifact to a file."""
        with self._http.stream("GET", f"/jobs/{job_id}/artifacts/{name}") as response:
            if response.status_code != 200:
                response.read()
                _check(response)
            with target.open("wb") as file:
                for block in response.iter_bytes(_BLOCK):
                    file.write(block)


def register_remotely(
    service: RemoteService, scene: Path, object_: Path, request: dict[str, Any], output: Path | None
) -> dict[str, Any]:
    """The whole exchange for one registration, with progress on stderr; returns the result document.

    Raises ServiceError, NoWorkerError; leaves with exit code 3 when the service cannot be reached.
    """

    def upload(report: Report) -> dict[str, Any]:
        return {"scene": service.upload_field(scene, report), "object": service.upload_field(object_, report)}

    return _exchange(service, upload, request, output)


def search_remotely(
    service: RemoteService, scene: Path, objects: Sequence[Path], request: dict[str, Any], output: Path | None
) -> dict[str, Any]:
    """The same for a search among ``objects``, which the document then names by their files."""
    files: dict[str, Path] = {}

    def upload(report: Report) -> dict[str, Any]:
        sent = {"scene": service.upload_field(scene, report)}
        for path in objects:
            files.setdefault(service.send(path, report), path)
        for sha256, path in files.items():
            try:
                service.wait_until_ready(sha256)
            except ServiceError as error:
                raise ServiceError(f"{path}: {error}", reason=error.reason) from error
        return {**sent, "candidates": list(files)}

    document = _exchange(service, upload, request, output)
    for place in (document, *document["candidates"]):
        place["object"] = str(files[place["object"]])
    return document


def _exchange(
    service: RemoteService,
    upload: Callable[[Report], dict[str, Any]],
    request: dict[str, Any],
    output: Path | None,
) -> dict[str, Any]:
    """Upload, post, follow, fetch."""
    try:
        with service, phase_progress() as bar:
            task = bar.add_task("uploading", total=1.0)

            def report(phase: str, share: float) -> None:
                bar.update(task, description=phase, completed=share)

            named = upload(report)
            body = {name: value for name, value in request.items() if value is not None}
            job = service.follow(service.submit({**named, **body})["id"], report)
            document = service.result(job["id"])
            if output is not None:
                output.mkdir(parents=True, exist_ok=True)
                for artifact in document["artifacts"]:
                    name = artifact["name"]
                    service.fetch_artifact(job["id"], name, output / Path(name).name)  # never outside the folder
            return document
    except httpx.RequestError as error:
        err.print()
        raise SystemExit(
            fail("SERVICE_UNAVAILABLE", f"{service.address} does not answer: {error}", EXIT_UNAVAILABLE)
        ) from error


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(response: httpx.Response) -> dict[str, Any]:
    """The JSON object of a good answer; raises ServiceError for a refusal, and for what is no regnf service."""
    try:
        document = response.json()
    except ValueError:
        document = None
    if response.is_success and isinstance(document, dict):
        return document
    error = _problem(document if isinstance(document, dict) else {"detail": f"HTTP status {response.status_code}"})
    error.unavailable = response.status_code in (502, 503, 504)
    raise error


def _problem(problem: dict[str, Any]) -> ServiceError:
    if problem.get("reason") == "JOB_FAILED" and isinstance(problem.get("error"), dict):
        problem = problem["error"]  # why the job failed says more than that it did
    detail = problem.get("detail") or problem.get("title") or "the service gave no detail"
    return ServiceError(str(detail), reason=str(problem.get("reason", ServiceError.reason)))
