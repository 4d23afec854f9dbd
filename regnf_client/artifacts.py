"""Files of a result: downloaded, in a second try from where the first one stopped, and compared with their digests."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from urllib.parse import quote

from regnf_client.answers import refusal
from regnf_client.errors import ServiceError
from regnf_client.fields import Asking
from regnf_client.jobs import JobLike, id_of
from regnf_client.models import Rendering, Result
from regnf_client.steps import Download, Flow, again, call, work

_PART = ".part"


def address_of(job: JobLike, name: str) -> str:
    """Where a file is."""
    return f"/jobs/{id_of(job)}/artifacts/{quote(name, safe='')}"


def artifact(asking: Asking, job: JobLike, name: str) -> Flow[bytes]:
    """The bytes of a file. Raises ServiceError (ARTIFACT_NOT_FOUND ...)."""
    answer = yield from call(asking.patience, "GET", address_of(job, name))
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
    answer = yield from again(asking.patience, Download(address_of(job, name), part))
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
