"""/library: objects by name, with tags, unit, note and symmetry."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from regnf_core.library_entries import MAX_NAME, MAX_TAG, EntryNotes
from regnf_service.concurrency import blocking, in_thread
from regnf_service.http import body
from regnf_service.http.body import CallerDep, LimitQuery, PageTokenQuery, PrefixDep, ServicesDep, read_json
from regnf_service.http.query import decode_token, encode_token, wants_page
from regnf_service.http.ranges import IfNoneMatch, file_answer
from regnf_service.http.routes.documentation import BINARY, JSON, header, refusals
from regnf_service.http.routes.pages import HTML, page
from regnf_service.http.schemas.library import (
    EntryChange,
    EntryDocument,
    EntryPage,
    NewEntry,
    SaidSymmetry,
    entry_document,
)
from regnf_service.http.schemas.reading import reference
from regnf_service.library import add_entry, change_entry, find_entry, remove_entry
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.ownership import sha256_of
from regnf_state.record_store import LibraryEntry

router = APIRouter(tags=["library"])
_PATCHES = (JSON, "application/merge-patch+json")
_BODY_REFUSALS = (
    "INVALID_HEADER MALFORMED_JSON UPLOAD_INCOMPLETE TOO_MANY_REQUESTS_AT_ONCE REQUEST_TOO_LARGE "
    "UNSUPPORTED_MEDIA_TYPE INVALID_REQUEST CONFLICT LIBRARY_NAME_TAKEN"
)
NamePath = Annotated[str, Path(description="Name of the entry.", max_length=4 * MAX_NAME)]


@router.get(
    "/library",
    summary="The library's entries, newest first",
    response_model=EntryPage,
    responses={200: {"content": HTML}, **refusals("INVALID_QUERY")},
)
@blocking
def list_library(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
    tag: Annotated[str | None, Query(max_length=MAX_TAG, description="Only entries with this tag.")] = None,
    name: Annotated[
        str | None, Query(max_length=MAX_NAME, description="Only entries whose name contains this text.")
    ] = None,
) -> Response:
    """A page may be short or empty although more pages follow. Continue while there is a `next_page_token`.

    A browser gets a page, which needs no token.
    """
    if wants_page(request.scope):
        return page("library.html")
    found = services.records.list_entries(caller, tag, name, limit, decode_token(page_token))
    entries = [entry for field in found.records if (entry := LibraryEntry.of(field)) is not None]
    documents = [entry_document(entry, prefix) for entry in entries]
    return JSONResponse({"entries": documents, "next_page_token": encode_token(found.rest)}, headers={"Vary": "Accept"})


@router.post(
    "/library",
    summary="Add a field to the library",
    response_model=EntryDocument,
    status_code=201,
    responses={
        200: {"description": "The same entry exists already.", "model": EntryDocument},
        201: {"headers": {"Location": header("The entry.")}},
        **refusals(_BODY_REFUSALS, "FIELD_NOT_FOUND", "FIELD_REJECTED", "FIELD_IN_LIBRARY"),
    },
    openapi_extra={"requestBody": {"required": True, "content": {JSON: {"schema": reference(NewEntry)}}}},
)
async def post_library(request: Request, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:
    """A field has at most one entry, with a name that the caller chooses. The field may still be `validating`.

    A worker then computes the object's model, the signature that searches compare, and the object's symmetry.
    """
    if body.media_type(request) != JSON:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/json.")
    asked = await read_json(request, services, caller, NewEntry)
    notes = EntryNotes.checked(asked.name, asked.tags, asked.unit, asked.note, _plain(asked.symmetry))
    entry, created = await in_thread(add_entry, services, caller, asked.field, notes)
    document = entry_document(entry, prefix)
    headers = {"Location": document["links"]["self"]}
    return JSONResponse(document, status_code=201 if created else 200, headers=headers)


@router.get(
    "/library/{name}",
    summary="An entry of the library",
    response_model=EntryDocument,
    responses=refusals("LIBRARY_ENTRY_NOT_FOUND"),
)
@blocking
def get_library_entry(name: NamePath, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:
    """The picture and the mesh of an entry are those of its field."""
    return JSONResponse(entry_document(find_entry(services, caller, name), prefix))


@router.patch(
    "/library/{name}",
    summary="Change an entry",
    response_model=EntryDocument,
    responses=refusals(_BODY_REFUSALS, "LIBRARY_ENTRY_NOT_FOUND", "INVALID_REQUEST"),
    openapi_extra={"requestBody": {"required": True, "content": {JSON: {"schema": reference(EntryChange)}}}},
)
async def patch_library_entry(
    name: NamePath, request: Request, services: ServicesDep, caller: CallerDep, prefix: PrefixDep
) -> JSONResponse:
    """A member that is left out is unchanged, also within `symmetry`. null removes a unit, a note or a symmetry, and
    `[]` removes all tags (RFC 7396)."""
    if body.media_type(request) not in _PATCHES:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", f"Send {' or '.join(_PATCHES)}.")
    change = await read_json(request, services, caller, EntryChange)
    entry = await in_thread(_changed, services, caller, name, change)
    return JSONResponse(entry_document(entry, prefix))


def _changed(services: Services, caller: str, name: str, change: EntryChange) -> LibraryEntry:
    said = change.model_dump(exclude_unset=True)
    if said.get("name", name) is None:
        del said["name"]
    held = find_entry(services, caller, name).notes.to_dict()
    if said.get("symmetry") is not None:
        said["symmetry"] = (held["symmetry"] or {"axis": None, "continuous": False}) | said["symmetry"]
    return change_entry(services, caller, name, EntryNotes.checked(**(held | said)))


@router.delete(
    "/library/{name}",
    summary="Remove an entry from the library",
    status_code=204,
    response_class=Response,
    responses=refusals("LIBRARY_ENTRY_NOT_FOUND", "CONFLICT"),
)
@blocking
def delete_library_entry(name: NamePath, services: ServicesDep, caller: CallerDep) -> Response:
    """The field is kept: `DELETE /fields/{sha256}` deletes it."""
    remove_entry(services, caller, name)
    return Response(status_code=204)


@router.get(
    "/library/{name}/file",
    summary="An entry's field as a regnf field file",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "The file. Any regnf service accepts it.",
            "content": {"application/octet-stream": BINARY},
        },
        **refusals("LIBRARY_ENTRY_NOT_FOUND", "FIELD_VALIDATING"),
    },
)
async def get_library_file(request: Request, name: NamePath, services: ServicesDep, caller: CallerDep) -> Response:
    """The imported field (docs/safe-format.md). It can be uploaded to another service."""
    field = (await in_thread(find_entry, services, caller, name)).field
    if field.state != "ready":
        raise Problem("FIELD_VALIDATING")
    headers = {"Content-Disposition": f'attachment; filename="{sha256_of(field.sha256)}.safetensors"'}
    try:
        key = f"fields/{field.sha256}/field.safetensors"
        return await file_answer(request, services.blobs, key, "application/octet-stream", headers, IfNoneMatch())
    except FileNotFoundError as error:
        raise Problem("LIBRARY_ENTRY_NOT_FOUND") from error


def _plain(said: SaidSymmetry | None) -> dict[str, Any] | None:
    return None if said is None else said.model_dump()
