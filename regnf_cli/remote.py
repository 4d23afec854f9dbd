"""One registration or search through a service, from the upload to the files, with what the command line says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from regnf_cli.report import err, reporting
from regnf_client import Client, Job
from regnf_client.fields import FieldLike
from regnf_core.errors import InvalidInputError, filled_folder
from regnf_core.field_source import FieldSource


def register_remotely(
    client: Client,
    scene: FieldSource,
    objects: FieldSource | list[FieldSource] | None,
    request: dict[str, Any],
    tag: str | None = None,
    output: Path | None = None,
    cancel: bool = False,
) -> dict[str, Any]:
    """The result document of a registration, or of a search among several objects, which it then names.

    objects: None searches among the entries of the caller's library that have the ``tag`` · request: members of POST
    /register but the fields · output: where to write the job's files · cancel: whether Ctrl+C cancels the job too.
    Raises ServiceError, UnreachableError, NoWorkerError; KeyboardInterrupt once the user has been told of the job.
    """
    with client, reporting("uploading") as report:
        known = dict(request)
        detection = known.pop("detection")
        searched: Any = _entries(client, tag) if objects is None else objects
        job = client.submit(scene, searched, detection, more=known, progress=report)
        page = f"{client.address}/jobs/{job.id}/view"
        err.print(f"job          {job.id}\npage         {page}", markup=False, soft_wrap=True)
        try:
            client.wait(job, report)
        except KeyboardInterrupt:
            _leave(client, job, page, cancel)
            raise
        found = client.result(job)
        if output is not None:
            with filled_folder(output) as folder:
                client.save(found, folder, report)
    document = found.document
    if found.candidates is not None:
        for place in (document, *document["candidates"]):
            place["object"] = job.sources.get(place["object"], place["object"])
    return document


def _entries(client: Client, tag: str | None) -> list[FieldLike]:
    found = [one for one in client.library.entries(tag) if one.state != "rejected"]
    if not found:
        which = "" if tag is None else f" with the tag {tag!r}"
        hint = "`regnf library add NAME FIELD --server ...` adds one."
        raise InvalidInputError(f"the library has no entries{which}", reason="LIBRARY_EMPTY", hint=hint)
    return [*found]


def _leave(client: Client, job: Job, page: str, cancel: bool) -> None:
    """Say what becomes of the job after Ctrl+C."""
    if cancel:
        client.cancel(job)
        said = f"canceled the job {job.id}"
    else:
        said = (
            f"the job {job.id} goes on: the same command follows it again, {page} shows it\n"
            f"To cancel it: curl -X POST {client.address}/jobs/{job.id}/cancel, "
            "or give --cancel-on-interrupt next time."
        )
    err.print(said, markup=False, soft_wrap=True)
