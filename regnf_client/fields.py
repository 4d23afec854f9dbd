"""Fields: what names one, and how it gets to the service. Nothing is sent of what the service has."""

from __future__ import annotations

import json
import math
import os
import re
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx

from regnf_client.answers import (
    ServiceError,
    WaitTimeoutError,
    checked,
    checked_address,
    checked_token,
    parsed,
    refusal,
    service_error,
)
from regnf_client.models import Entry, Field
from regnf_client.steps import Flow, Patience, WorkerWatch, call, look, work
from regnf_core.errors import Said
from regnf_core.field_source import FieldSource, Role, SettingsChoice, assumed_role, find_source
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.in_memory import HasGeometry, HasPoints, HasVertices
from regnf_core.library_folder import digest_of

Sendable = str | Path | FieldSource | HasVertices | HasPoints | HasGeometry
FieldLike = Sendable | Field | Entry
"""A file, a training run's folder or an archive of one; the SHA-256 of a field that the service has; or a Field or an
Entry of its library; or a mesh or a cloud of trimesh or Open3D, or a mesh that regnf has opened."""
Report = Callable[[str, float], None]
"""Called with a phase and the share of it that is done, 0..1."""
PIECE_BYTES = 8 << 20
"""A file that is larger is sent in pieces: a broken connection costs one of them."""
_MOST_PIECES = 900
_HOLD_S = 20
_SHA256 = re.compile(r"[0-9a-f]{64}")
_NOT_OF_A_FILE = frozenset({"UNAUTHENTICATED", "RATE_LIMITED", ServiceError.reason})


@dataclass(frozen=True)
class Asking:
    """How a client asks. watch: of the service's workers · timeout_s: the most that a wait may take; None: any time."""

    patience: Patience
    watch: WorkerWatch
    report: Report | None = None
    timeout_s: float | None = None

    def tell(self, phase: str, share: float) -> None:
        """Report to the caller, who may not want to know."""
        if self.report is not None:
            self.report(phase, share)

    def deadline(self) -> Deadline:
        """Of a wait that begins now."""
        return Deadline(self.timeout_s)


class Deadline:
    """When a wait ends. None: never."""

    def __init__(self, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self._end = math.inf if timeout_s is None else time.monotonic() + timeout_s

    def hold_s(self) -> int:
        """For how long the service may hold one answer."""
        left_s = self._end - time.monotonic()
        return _HOLD_S if left_s >= _HOLD_S else max(0, math.ceil(left_s))

    def check(self, what: str) -> None:
        """Raises WaitTimeoutError once the time is over. what: is waited for."""
        if time.monotonic() >= self._end:
            hint = "It goes on: the same call finds it again. Give a larger timeout_s, or None."
            raise WaitTimeoutError(f"{what} has not ended within {self._timeout_s:g} s", hint=hint)


def source_of(
    field: Sendable,
    description: Mapping[str, Any] | None = None,
    settings: SettingsChoice = None,
    role: Role | None = None,
) -> FieldSource:
    """What a path stands for, or a mesh or a cloud in memory, of which a file is made for as long as it is needed.

    Raises what ``find_source`` does, InvalidInputError and FieldFormatError.
    """
    if isinstance(field, FieldSource):
        return field
    if isinstance(field, str | os.PathLike):
        return find_source(Path(field), description, settings, role)
    from regnf_core.importing.meshes.ply import ply_bytes
    from regnf_core.in_memory import geometry_of

    data = ply_bytes(geometry_of(field, role))
    folder = TemporaryDirectory(prefix="regnf-")
    file = Path(folder.name) / f"{type(field).__name__}.ply"
    file.write_bytes(data)
    said = dict(description or {})
    use = assumed_role(said, "ply", role).get("as")
    source = FieldSource(Path(file.name), file, None, None, said, use, role)
    weakref.finalize(source, folder.cleanup)
    return source


def known_sha256(field: FieldLike) -> str | None:
    """The SHA-256 of a field that is named by it; None for a file."""
    if isinstance(field, Field):
        return field.sha256
    if isinstance(field, Entry):
        return field.field
    is_name = isinstance(field, str) and _SHA256.fullmatch(field) is not None
    return str(field) if is_name and not Path(str(field)).exists() else None


def smallest_first(given: Mapping[Role, FieldLike]) -> list[tuple[Role, FieldLike]]:
    """What the service has, then the files, the smallest first: what is refused is refused soon.

    Raises what ``source_of`` does.
    """
    sized: list[tuple[int, Role, FieldLike]] = []
    for role, field in given.items():
        if known_sha256(field) is not None:
            sized.append((0, role, field))
        else:
            source = source_of(_path(field), role=role)
            sized.append((source.file.stat().st_size, role, source))
    return [(role, field) for _, role, field in sorted(sized, key=lambda one: one[0])]


def upload(asking: Asking, field: FieldLike, role: Role | None = None, wait: bool = True) -> Flow[Field]:
    """The field at the service, once its import has ended; its bytes are sent only if the service lacks them.

    wait: False leaves the import running. Raises ServiceError: of a refused field the gate's reason,
    FIELD_DESCRIPTION_DIFFERS for bytes that are held as another function; both name the file.
    """
    (found,) = yield from upload_all(asking, [field], role, wait)
    return found


def upload_all(
    asking: Asking, given: Sequence[FieldLike], role: Role | None = None, wait: bool = True
) -> Flow[list[Field]]:
    """The same of several: all are sent before the first import is waited for."""
    sources = [None if known_sha256(one) is not None else source_of(_path(one), role=role) for one in given]
    sent = []
    for one, source in zip(given, sources, strict=True):
        with _naming(source):
            sent.append((yield from send(asking, one if source is None else source)))
    if not wait:
        return sent
    found = []
    for one, source in zip(sent, sources, strict=True):
        with _naming(source):
            found.append((yield from ready(asking, one)))
    return found


@contextmanager
def _naming(source: FieldSource | None) -> Iterator[None]:
    """Refusals of a field name its file."""
    try:
        yield
    except ServiceError as error:
        if source is None or error.unavailable or error.reason in _NOT_OF_A_FILE:
            raise
        named = error.told(f"{source.named}: {error}")
        named.said = Said(source.use, source.said)
        raise named from error


def send(asking: Asking, field: FieldLike) -> Flow[Field]:
    """The field at the service, while its import may still run."""
    if known_sha256(field) is not None:
        return (yield from find(asking, field))
    source = source_of(_path(field))
    sha256 = yield from work(partial(digest_of, source.file))
    answer = yield from call(asking.patience, "GET", f"/fields/{sha256}")
    if answer.status_code != 404:
        known = parsed(Field, checked(answer))
        if known.state != "rejected":
            _require_same(known, source)
            return (yield from _named(asking, known, source))
    with source.packed_settings() as settings:
        return (yield from _Sending(asking, source, sha256, settings).all())


def _named(asking: Asking, known: Field, source: FieldSource) -> Flow[Field]:
    """The field that the service holds, by the name that it is now given, or by the file's where it has none."""
    if not source.label or known.label == source.label or (known.label is not None and "label" not in source.said):
        return known
    answer = yield from call(asking.patience, "PATCH", f"/fields/{known.sha256}", json={"label": source.label})
    return parsed(Field, checked(answer)) if answer.is_success else known  # a name is no condition


def find(asking: Asking, field: FieldLike) -> Flow[Field]:
    """A field as the service has it now. Raises ServiceError (FIELD_NOT_FOUND)."""
    sha256 = known_sha256(field)
    if sha256 is None:
        sha256 = yield from work(partial(digest_of, source_of(_path(field)).file))
    return parsed(Field, checked((yield from call(asking.patience, "GET", f"/fields/{sha256}"))))


def ready(asking: Asking, field: Field) -> Flow[Field]:
    """The field once its import has ended. Raises ServiceError with the gate's reason when it was rejected."""
    deadline = asking.deadline()
    while field.state == "validating":
        asking.tell("importing", 0.0)
        params = {"wait": deadline.hold_s()}
        answer = yield from call(asking.patience, "GET", f"/fields/{field.sha256}", params=params)
        field = parsed(Field, checked(answer))
        if field.state == "validating":
            deadline.check(f"the import of {field.sha256[:12]}")
            yield from look(asking.watch, asking.patience)
    if field.state == "rejected":
        raise service_error(field.error or {})
    return field


def _path(field: FieldLike) -> Sendable:
    assert not isinstance(field, Field | Entry)
    return field


@dataclass(frozen=True)
class _Sending:
    """One file on its way."""

    asking: Asking
    source: FieldSource
    sha256: str
    settings: Path | None

    def all(self) -> Flow[Field]:
        size = self.source.file.stat().st_size
        if size <= PIECE_BYTES:
            data = yield from work(self.source.file.read_bytes)
            return (yield from self._at_once(data))
        return (yield from self._in_pieces(size))

    def _beside(self) -> dict[str, Any]:
        """The parts of a form that go with the file."""
        parts: dict[str, Any] = {"description": (None, json.dumps(self.source.description_to_send), "application/json")}
        if self.settings is not None:
            parts["settings"] = (self.settings.name, self.settings.read_bytes(), "application/octet-stream")
        return parts

    def _at_once(self, data: bytes) -> Flow[Field]:
        self.asking.tell("uploading", 0.0)
        form = {"file": (self.source.file.name, data, "application/octet-stream"), **self._beside()}
        answer = yield from call(self.asking.patience, "POST", "/fields", files=form)
        self.asking.tell("uploading", 1.0)
        return parsed(Field, checked(answer))

    def _in_pieces(self, size: int) -> Flow[Field]:
        """From where an earlier try stopped."""
        piece = max(PIECE_BYTES, -(-size // _MOST_PIECES))
        answer = yield from self._put(b"", f"bytes */{size}")
        while True:
            document = checked(answer)
            offset = document.get("offset")
            if offset is None:
                return parsed(Field, document)
            self.asking.tell("uploading", offset / size)
            if offset == size:
                break
            data = yield from work(partial(_read, self.source.file, offset, piece))
            span = f"bytes {offset}-{offset + len(data) - 1}/{size}"
            answer = yield from self._put(data, span)
            if answer.status_code == 409 and refusal(answer).offset not in (None, offset):
                answer = yield from self._put(b"", f"bytes */{size}")  # the answer to a piece was lost
        form = {"upload": (None, self.sha256), **self._beside()}
        answer = yield from call(self.asking.patience, "POST", "/fields", files=form)
        return parsed(Field, checked(answer))

    def _put(self, data: bytes, span: str) -> Flow[Any]:
        headers = {"Content-Range": span, "Content-Type": "application/octet-stream", "Upload-Complete": "?0"}
        return call(self.asking.patience, "PUT", f"/fields/{self.sha256}", content=data, headers=headers)


def _read(path: Path, offset: int, size: int) -> bytes:
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(size)


def _require_same(held: Field, source: FieldSource) -> None:
    """Raises ServiceError FIELD_DESCRIPTION_DIFFERS unless the service has the field as the user wants it.

    What it will be used as is no condition, as long as the user has not said it.
    """
    with source.packed_settings() as settings:
        if not source.said and settings is None:
            return
        digest = None if settings is None else digest_of(settings)
    said = UploadDescription.from_dict(dict(source.said)).non_default()
    wanted = {name: value for name, value in said.items() if name != "label"}
    found = {name: value for name, value in held.description.items() if name in wanted or name != "as"}
    if (wanted, digest) != (found, (held.settings or {}).get("sha256")):
        message = "the service holds the same bytes with another description or other settings"
        hint = f"Delete the field there first (DELETE /fields/{held.sha256}), or leave them out."
        raise ServiceError(message, reason="FIELD_DESCRIPTION_DIFFERS", hint=hint)


# What both clients are made of: address, token, patience.

ADDRESS = "http://127.0.0.1:8080"
WORKER_TIMEOUT_S = 60.0
_AROUND = "\ufeff \t\r\n"
"""What a shell keeps of a file that Windows wrote."""
_TIMEOUT = httpx.Timeout(60.0, connect=5.0)


@dataclass(frozen=True)
class Connection:
    """Address, token and manners of a client."""

    address: str
    token: str | None
    retries: int
    worker_timeout_s: float | None

    def http_options(self) -> dict[str, Any]:
        """Of httpx's clients. Raises InvalidInputError (INVALID_ADDRESS, INVALID_TOKEN)."""
        checked_address(self.address)
        token = self.token if self.token is not None else os.environ.get("REGNF_API_TOKEN")
        headers = {"Authorization": f"Bearer {checked_token(token.strip(_AROUND))}"} if token else {}
        return {"base_url": self.address.rstrip("/"), "headers": headers, "timeout": _TIMEOUT}

    def asking(self, report: Report | None = None, timeout_s: float | None = None) -> Asking:
        """For one call of a method."""
        return Asking(Patience(retries=self.retries), WorkerWatch(self.worker_timeout_s), report, timeout_s)
