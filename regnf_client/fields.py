"""Fields: the ways to give one, and the upload to the service. Files that the service has are not sent again."""

from __future__ import annotations

import json
import os
import re
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import httpx

from regnf_client.answers import ServiceError, checked, parsed, refusal, service_error
from regnf_client.models import Entry, Field
from regnf_client.steps import Asking, Flow, work
from regnf_core.errors import Said
from regnf_core.field_source import FieldSource, Role, SettingsChoice, assumed_role, find_source
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.in_memory import HasGeometry, HasPoints, HasVertices
from regnf_core.library_folder import digest_of

Sendable = str | Path | FieldSource | HasVertices | HasPoints | HasGeometry
FieldLike = Sendable | Field | Entry
"""A file, the folder of a training run or an archive of such a folder; the SHA-256 of a field on the service; a Field,
or an Entry of the library; a mesh or point cloud of trimesh or Open3D; or a mesh that regnf has opened."""
PIECE_BYTES = 8 << 20
"""A file that is larger is sent in pieces: a broken connection costs one of them."""
_MOST_PIECES = 900
_BYTES = "application/octet-stream"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_NOT_OF_A_FILE = frozenset({"UNAUTHENTICATED", "RATE_LIMITED", ServiceError.reason})


def source_of(
    field: Sendable,
    description: Mapping[str, Any] | None = None,
    settings: SettingsChoice = None,
    role: Role | None = None,
) -> FieldSource:
    """The source of a path, or of a mesh or point cloud in memory, for which a temporary file is written.

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
    """The SHA-256 of a field that is given by it; None for a file."""
    if isinstance(field, Field):
        return field.sha256
    if isinstance(field, Entry):
        return field.field
    is_name = isinstance(field, str) and _SHA256.fullmatch(field) is not None
    return str(field) if is_name and not Path(str(field)).exists() else None


def named(field: FieldLike, role: Role | None = None) -> str | FieldSource:
    """The SHA-256 of a field that is given by it, or the file to send. Raises what ``source_of`` does."""
    return known_sha256(field) or source_of(cast("Sendable", field), role=role)


def smallest_first(given: Mapping[Role, FieldLike]) -> list[tuple[Role, str | FieldSource]]:
    """Fields that the service has, then the files, smallest first, so that refusals come early.

    Raises what ``source_of`` does.
    """
    found = [(role, named(field, role)) for role, field in given.items()]
    return sorted(found, key=lambda one: 0 if isinstance(one[1], str) else one[1].file.stat().st_size)


def upload(asking: Asking, field: FieldLike, role: Role | None = None, wait: bool = True) -> Flow[Field]:
    """Upload a field and wait for its import. Its bytes are sent only if the service does not have them.

    wait: False leaves the import running. Raises ServiceError: the importer's reason for a refused field, or
    FIELD_DESCRIPTION_DIFFERS if the file is stored with other import options. Both have the name of the file.
    """
    (found,) = yield from upload_all(asking, [field], role, wait)
    return found


def upload_all(
    asking: Asking, given: Sequence[FieldLike], role: Role | None = None, wait: bool = True
) -> Flow[list[Field]]:
    """Upload several fields. All are sent before the first import is waited for."""
    sources = [named(one, role) for one in given]
    found = []
    for one in sources:
        with _naming(one):
            found.append((yield from _sent(asking, one)))
    for number, one in enumerate(sources if wait else ()):
        with _naming(one):
            found[number] = yield from ready(asking, found[number])
    return found


@contextmanager
def _naming(source: str | FieldSource) -> Iterator[None]:
    """Refusals of a field name its file."""
    try:
        yield
    except ServiceError as error:
        if isinstance(source, str) or error.unavailable or error.reason in _NOT_OF_A_FILE:
            raise
        told = error.told(f"{source.named}: {error}")
        told.said = Said(source.use, source.said)
        raise told from error


def _sent(asking: Asking, source: str | FieldSource) -> Flow[Field]:
    """The field at the service, while its import may still run."""
    if isinstance(source, str):
        return (yield from find(asking, source))
    sha256 = yield from work(partial(digest_of, source.file))
    answer = yield from asking.call("GET", f"/fields/{sha256}")
    if answer.status_code != 404:
        known = parsed(Field, checked(answer))
        if known.state != "rejected":
            _require_same(known, source)
            return (yield from _labeled(asking, known, source))
    return (yield from _send(asking, source, sha256))


def _labeled(asking: Asking, known: Field, source: FieldSource) -> Flow[Field]:
    """The field that the service holds, by the name that it is now given, or by the file's where it has none."""
    if not source.label or known.label == source.label or (known.label is not None and "label" not in source.said):
        return known
    answer = yield from asking.call("PATCH", f"/fields/{known.sha256}", json={"label": source.label})
    return parsed(Field, checked(answer)) if answer.is_success else known  # a name is no condition


def find(asking: Asking, field: FieldLike) -> Flow[Field]:
    """The current state of a field on the service. Raises ServiceError (FIELD_NOT_FOUND)."""
    source = named(field)
    sha256 = source if isinstance(source, str) else (yield from work(partial(digest_of, source.file)))
    return (yield from asking.document(Field, "GET", f"/fields/{sha256}"))


def ready(asking: Asking, field: Field) -> Flow[Field]:
    """Wait until the import of a field has ended. Raises ServiceError with the importer's reason if the field was
    rejected."""
    deadline = asking.deadline()
    while field.state == "validating":
        asking.tell("importing", 0.0)
        field = yield from asking.document(Field, "GET", f"/fields/{field.sha256}", params={"wait": deadline.hold_s()})
        if field.state == "validating":
            deadline.check(f"the import of {field.sha256[:12]}")
            yield from asking.look()
    if field.state == "rejected":
        raise service_error(field.error or {})
    return field


def _send(asking: Asking, source: FieldSource, sha256: str) -> Flow[Field]:
    """Send the file with what goes beside it: at once, or in pieces from where an earlier try stopped."""
    beside: dict[str, Any] = {"description": (None, json.dumps(source.description_to_send), "application/json")}
    with source.packed_settings() as settings:
        if settings is not None:
            beside["settings"] = (settings.name, settings.read_bytes(), _BYTES)
    size = source.file.stat().st_size
    if size <= PIECE_BYTES:
        asking.tell("uploading", 0.0)
        form: dict[str, Any] = {"file": (source.file.name, (yield from work(source.file.read_bytes)), _BYTES)}
    else:
        held = yield from send_pieces(asking, source.file, f"/fields/{sha256}", size)
        if held is not None:
            return held
        form = {"upload": (None, sha256)}
    field = yield from asking.document(Field, "POST", "/fields", files=form | beside)
    asking.tell("uploading", 1.0)
    return field


def send_pieces(asking: Asking, file: Path, address: str, size: int) -> Flow[Field | None]:
    """Send all pieces that have not arrived. Returns the field if the service has it."""

    def put(data: bytes, span: str) -> Flow[httpx.Response]:
        headers = {"Content-Range": f"bytes {span}/{size}", "Content-Type": _BYTES, "Upload-Complete": "?0"}
        return asking.call("PUT", address, content=data, headers=headers)

    answer = yield from put(b"", "*")
    while True:
        document = checked(answer)
        offset = document.get("offset")
        if offset is None:
            return parsed(Field, document)
        if offset == size:
            return None
        asking.tell("uploading", offset / size)
        data = yield from work(partial(_read, file, offset, max(PIECE_BYTES, -(-size // _MOST_PIECES))))
        answer = yield from put(data, f"{offset}-{offset + len(data) - 1}")
        if answer.status_code == 409 and refusal(answer).offset not in (None, offset):
            answer = yield from put(b"", "*")  # the answer to a piece was lost


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
        message = "the service has the same file with another `description` or `config`"
        hint = f"Delete the field on the service first (DELETE /fields/{held.sha256}), or leave both out."
        raise ServiceError(message, reason="FIELD_DESCRIPTION_DIFFERS", hint=hint)
