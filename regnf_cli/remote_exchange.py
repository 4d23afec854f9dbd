"""One registration or search through a service, from the upload to the files, for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from rich.progress import Progress

from regnf_cli.remote import RemoteService, Report, unreachable
from regnf_cli.report import err, phase_progress
from regnf_client.answers import ServiceError
from regnf_core.errors import Said, filled_folder
from regnf_core.field_source import FieldSource

_NOT_OF_A_FILE = frozenset({"UNAUTHENTICATED", "RATE_LIMITED", "TOO_MANY_WRITES", ServiceError.reason})


@dataclass(frozen=True)
class Delivery:
    """output: where to write the job's files, if anywhere · cancel: whether Ctrl+C cancels the job too."""

    output: Path | None = None
    cancel: bool = False


def register_remotely(
    service: RemoteService, scene: FieldSource, object_: FieldSource, request: dict[str, Any], delivery: Delivery
) -> dict[str, Any]:
    """The whole exchange for one registration, with progress on stderr; returns the result document.

    Raises ServiceError, UnreachableError, NoWorkerError; KeyboardInterrupt once the user has been told of the job.
    """

    def upload(report: Report) -> dict[str, Any]:
        named = {"scene": scene, "object": object_}
        smallest_first = sorted(named, key=lambda role: named[role].file.stat().st_size)  # a refusal comes soon
        return {role: _sent(service, named[role], report) for role in smallest_first}

    return _exchange(service, upload, request, delivery)


def search_remotely(
    service: RemoteService,
    scene: FieldSource,
    objects: Sequence[FieldSource],
    request: dict[str, Any],
    delivery: Delivery,
) -> dict[str, Any]:
    """The same for a search among ``objects``, which the document then names by their files."""
    files: dict[str, FieldSource] = {}

    def upload(report: Report) -> dict[str, Any]:
        sent = {"scene": _sent(service, scene, report)}
        for one in objects:
            with _named(one):
                files.setdefault(service.send(one, report), one)
        for sha256, source in files.items():
            with _named(source):
                service.wait_until_ready(sha256)
        return {**sent, "candidates": list(files)}

    document = _exchange(service, upload, request, delivery)
    for place in (document, *document["candidates"]):
        place["object"] = str(files[place["object"]].named)
    return document


def search_its_library(
    service: RemoteService, scene: FieldSource, tag: str | None, request: dict[str, Any], delivery: Delivery
) -> dict[str, Any]:
    """The same among the entries of the caller's library at the service, which the document names."""
    names: dict[str, str] = {}

    def upload(report: Report) -> dict[str, Any]:
        names.update({one["field"]: one["name"] for one in service.library()})
        wanted = {} if tag is None else {"tags": [tag]}
        return {"scene": _sent(service, scene, report), "candidates": {"library": wanted}}

    document = _exchange(service, upload, request, delivery)
    for place in (document, *document["candidates"]):
        place["object"] = names.get(place["object"], place["object"])
    return document


def _sent(service: RemoteService, source: FieldSource, report: Report) -> str:
    with _named(source):
        return service.upload_field(source, report)


@contextmanager
def _named(source: FieldSource) -> Iterator[None]:
    """Refusals of a field name its file."""
    try:
        yield
    except ServiceError as error:
        if error.unavailable or error.reason in _NOT_OF_A_FILE:
            raise
        named = ServiceError(f"{source.named}: {error}", reason=error.reason, hint=error.hint)
        named.candidates, named.said = error.candidates, Said(source.use, source.said)
        raise named from error


def _exchange(
    service: RemoteService, upload: Callable[[Report], dict[str, Any]], request: dict[str, Any], delivery: Delivery
) -> dict[str, Any]:
    """Upload, post, follow, fetch."""
    try:
        with service, phase_progress() as bar:
            task = bar.add_task("uploading", total=1.0)

            def report(phase: str, share: float) -> None:
                bar.update(task, description=phase, completed=share)

            named = upload(report)
            body = {name: value for name, value in request.items() if value is not None}
            job_id = service.submit({**named, **body})["id"]
            _announce(bar, service, job_id)
            try:
                service.follow(job_id, report)
            except KeyboardInterrupt:
                bar.stop()
                _leave(service, job_id, delivery.cancel)
                raise
            document = service.result(job_id)
            _fetch(service, job_id, document, delivery.output)
            return document
    except httpx.RequestError as error:
        raise unreachable(service.address, error) from error


def _announce(bar: Progress, service: RemoteService, job_id: str) -> None:
    bar.console.print(f"job          {job_id}", markup=False, soft_wrap=True)
    bar.console.print(f"page         {service.page(job_id)}", markup=False, soft_wrap=True)


def _leave(service: RemoteService, job_id: str, cancel: bool) -> None:
    """Say what becomes of the job after Ctrl+C."""
    if cancel:
        service.cancel(job_id)
        said = f"cancelled the job {job_id}"
    else:
        said = (
            f"the job {job_id} goes on: the same command follows it again, {service.page(job_id)} shows it\n"
            f"To cancel it: curl -X POST {service.address}/jobs/{job_id}/cancel, "
            "or give --cancel-on-interrupt next time."
        )
    err.print(said, markup=False, soft_wrap=True)


def _fetch(service: RemoteService, job_id: str, document: dict[str, Any], output: Path | None) -> None:
    if output is None:
        return
    with filled_folder(output) as folder:
        for artifact in document["artifacts"]:
            name = artifact["name"]
            service.fetch_artifact(job_id, name, folder / Path(name).name)  # never outside the folder
