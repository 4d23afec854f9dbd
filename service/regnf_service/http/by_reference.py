"""A registration request whose fields are named: what it asks for, and which fields the caller must have."""

from __future__ import annotations

from regnf_service.http.library_selection import CallersLibrary
from regnf_service.http.schemas.library import LibrarySelection
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_state.registration_request import RegistrationRequest


def asked_by_reference(library: CallersLibrary, spec: RegisterRequest) -> tuple[RegistrationRequest, dict[str, str]]:
    """The job's request, and the fields that the caller must have beside the scene's, by where they are named.

    Raises Problem LIBRARY_ENTRY_NOT_FOUND, LIBRARY_EMPTY, LIBRARY_TOO_LARGE.
    """
    object_, candidates = library.objects_meant(spec.object, spec.candidates)
    named = {"/scene": spec.scene}
    if object_ is not None:
        named["/object"] = object_
    if not isinstance(spec.candidates, LibrarySelection):  # the library's are there
        named |= {f"/candidates/{place}": sha256 for place, sha256 in enumerate(candidates or ())}
    return spec.to_request(spec.scene, object_, candidates), named
