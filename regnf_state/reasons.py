"""Every reason the HTTP interface can give, with its status, title and meaning: the table that clients program against.

Stable: a reason is never renamed, and never changes its meaning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.errors import hint_of


@dataclass(frozen=True)
class Reason:
    """One way to be refused: its HTTP status, a short title, and what the caller can do about it."""

    status: int
    title: str
    meaning: str


REASONS: dict[str, Reason] = {
    # the request as such
    "MALFORMED_JSON": Reason(
        400, "Malformed JSON", "The body is not one JSON value, names a member twice, or nests too deeply."
    ),
    "INVALID_QUERY": Reason(
        400,
        "Invalid query",
        "`errors` names the parameters that are unknown, given twice, of the wrong type or out of range.",
    ),
    "INVALID_HEADER": Reason(400, "Invalid header", "A request header does not follow its grammar or its limits."),
    "UNAUTHENTICATED": Reason(401, "Authentication required", "Send `Authorization: Bearer` with a valid token."),
    "HOST_NOT_ALLOWED": Reason(
        421,
        "Host not allowed",
        "The service does not answer under the name in `Host`. List the name in REGNF_ALLOWED_HOSTS, or use another.",
    ),
    "ORIGIN_NOT_ALLOWED": Reason(
        403,
        "Origin not allowed",
        "A browser sent this for a page of another site. A proxy must pass `Host` on unchanged, with its port.",
    ),
    "NOT_FOUND": Reason(404, "Not found", "There is nothing under this address. `GET /` names every address."),
    "METHOD_NOT_ALLOWED": Reason(405, "Method not allowed", "The header `Allow` lists what this address answers to."),
    "RATE_LIMITED": Reason(
        429, "Too many calls", "You send requests faster than the service allows. See `Retry-After`."
    ),
    "TOO_MANY_REQUESTS_AT_ONCE": Reason(
        429, "Too many requests at once", "Wait until some of your requests have been answered, then repeat."
    ),
    "CONFLICT": Reason(409, "Conflict", "Another client changed it at the same time. Read it again, then repeat."),
    "REQUEST_TOO_LARGE": Reason(
        413,
        "Request too large",
        "The JSON, a text part or a batch exceeds the service's limit of bytes, values or lines.",
    ),
    "UNSUPPORTED_MEDIA_TYPE": Reason(
        415, "Unsupported media type", "The `Content-Type` or `Content-Encoding` is not one this address takes."
    ),
    "INVALID_REQUEST": Reason(422, "Invalid request", "`errors` points at the members that are wrong."),
    # multipart
    "MALFORMED_MULTIPART": Reason(
        400,
        "Malformed multipart body",
        "The parts cannot be read, one is missing, or one is not known at this address.",
    ),
    # uploads
    "INVALID_DIGEST": Reason(400, "Invalid digest", "A SHA-256 is 64 lower-case hexadecimal digits."),
    "DIGEST_MISMATCH": Reason(400, "Digest mismatch", "The bytes that arrived are not the bytes that were announced."),
    "UPLOAD_INCOMPLETE": Reason(
        400, "Incomplete upload", "The body has no bytes, or ended before its declared length."
    ),
    "UPLOAD_TOO_LARGE": Reason(413, "Upload too large", "The file exceeds the service's limit. Nothing was kept."),
    "UPLOAD_NOT_FINISHED": Reason(
        409,
        "Upload not finished",
        "The pieces are not all here, or this is not the next one: `offset` says how many bytes have arrived.",
    ),
    "TOO_MANY_PIECES": Reason(409, "Too many pieces", "The upload has too many pieces. Send larger ones."),
    "FIELD_NOT_RECOGNIZED": Reason(
        415, "Not a field file", "The file is not a field in any format that the service reads."
    ),
    "QUOTA_STORED": Reason(
        403, "Quota of storage used up", "You store as many fields or bytes as you may. Delete some."
    ),
    "QUOTA_ACTIVE_JOBS": Reason(
        429,
        "Quota of jobs used up",
        "You have the maximum number of jobs, imports or batches that wait or run. Wait for one to end.",
    ),
    "QUOTA_WORKER_SECONDS": Reason(
        429,
        "Quota of worker time used up",
        "Your imports and jobs of the last hour have used the time that you may use. See `Retry-After`.",
    ),
    "STORAGE_FULL": Reason(
        507, "Storage full", "No space is left in the storage or the record store. Delete something, or retry later."
    ),
    # fields
    "FIELD_NOT_FOUND": Reason(404, "No such field", "Upload it with `PUT /fields/{sha256}` first."),
    "FIELD_VIEW_NOT_FOUND": Reason(
        404,
        "No view",
        "Only fields that are `ready` have a picture and a mesh to look at, and not those that are too slow for it. "
        "With `Retry-After` it is still to be made. Candidates of a rejected field have pictures while its upload is "
        "kept.",
    ),
    "FIELD_IN_USE": Reason(409, "Field in use", "Active jobs need the field. Wait for them, or cancel them."),
    "FIELD_DESCRIPTION_DIFFERS": Reason(
        409,
        "Field stored with another description",
        "The same bytes are stored with another description or other settings. Change it with `PATCH`, or delete the "
        "field first.",
    ),
    "FIELD_VALIDATING": Reason(409, "Import has not ended", "The field is being imported. Wait for it, then repeat."),
    "FIELD_BYTES_GONE": Reason(
        409,
        "Bytes no longer kept",
        "The uploaded bytes were deleted after their import. Delete the field, and upload it with the description.",
    ),
    "FIELD_REJECTED": Reason(
        422, "Field was rejected", "The import refused the file; `GET /fields/{sha256}` says why in `error`."
    ),
    "INVALID_DESCRIPTION": Reason(422, "Invalid description", "`errors` points at the members that are wrong."),
    # the library
    "LIBRARY_ENTRY_NOT_FOUND": Reason(
        404, "No such entry", "Your library has no entry of this name. `GET /library` lists them."
    ),
    "LIBRARY_NAME_TAKEN": Reason(
        409, "Name taken", "Another entry of your library has the name. Choose another one, or remove that entry."
    ),
    "FIELD_IN_LIBRARY": Reason(
        409,
        "Field in the library",
        "The field is an entry of your library already, or still: `GET /fields/{sha256}` has its name in `library`.",
    ),
    "LIBRARY_EMPTY": Reason(422, "No objects in the library", "No entry of your library is meant. Check the tags."),
    "LIBRARY_TOO_LARGE": Reason(
        422,
        "Too many objects",
        "The request names more entries than one search takes. Name fewer, or a tag that fewer have.",
    ),
    # registration requests
    "IDEMPOTENCY_KEY_REUSED": Reason(
        422, "Idempotency key reused", "The key came with another request within the last 24 hours. Use a new one."
    ),
    "INVALID_DETECTION": Reason(
        422, "Invalid detection", "The box is malformed: every number finite, every edge positive, min below max."
    ),
    "INVALID_OPTIONS": Reason(422, "Invalid options", "An option is unknown, of the wrong type or out of its range."),
    "OPTIONS_TOO_COSTLY": Reason(
        422,
        "Options too costly",
        "The options multiply to more memory or time than one job may have; `errors` names them, with both numbers.",
    ),
    "INVALID_TRANSFORM": Reason(
        422,
        "Invalid transform",
        "The matrix is no similarity transform: (s R, t) with s > 0, R a rotation, last row 0 0 0 1.",
    ),
    "PRESET_UNSUITABLE": Reason(
        422,
        "Not with this preset",
        "Only the preset `robust` searches among several objects, or starts from a given transform, with one object.",
    ),
    "DETECTION_OUTSIDE_SCENE": Reason(
        422, "Detection outside the scene", "The box and the scene's bounds do not overlap. Check frame and unit."
    ),
    "WEBHOOK_NOT_ALLOWED": Reason(
        422, "Webhook not allowed", "The service does not allow its host, or has no secret of yours to sign with."
    ),
    "QUEUE_FULL": Reason(
        503, "Queue full", "The service has the maximum number of active jobs. Retry after `Retry-After`."
    ),
    "QUOTA_WEBHOOKS": Reason(409, "Quota of webhooks used up", "The job has 16 webhooks, or 4 kB. Ask for its state."),
    # renderings
    "CAMERA_INVALID": Reason(
        422,
        "Invalid camera",
        "A camera's pose, lens or size is none, its path has no frame, or it stands in matter. `detail` says which.",
    ),
    "COLORS_MISSING": Reason(
        422,
        "No colors",
        "Colors are asked for, and no field has any. Let them be shaded: `coloring` `auto`.",
    ),
    "EDIT_INVALID": Reason(
        422,
        "Invalid edit",
        "The edit is no substitution, replacement, removal or insertion, its job is of no use for it, it lies outside "
        "of the scene, or two edits change the same place. `detail` says which.",
    ),
    "NO_SURFACE_IN_SCENE": Reason(
        422,
        "No surface in the scene",
        "The scene's field has no zero level within its bounds.",
    ),
    "RENDER_TOO_LARGE": Reason(
        422,
        "Rendering too large",
        "Too many frames or pixels, or more memory, time or files than one job may have; `detail` has both numbers. "
        "Ask for fewer or smaller frames.",
    ),
    "FIELD_NOT_FINITE": Reason(422, "Field not finite", "The field gives values that are not finite."),
    # jobs
    "JOB_NOT_FOUND": Reason(404, "No such job", "The id is unknown, or the job was deleted."),
    "ARTIFACT_NOT_FOUND": Reason(404, "No such artifact", "The result's `artifacts` list names what the job wrote."),
    "JOB_NOT_READY": Reason(409, "Job not finished", "The job has no result yet. Retry after `Retry-After`."),
    "JOB_DISMISSED": Reason(409, "Job was dismissed", "The job was cancelled. Post the request again to run it."),
    "JOB_FAILED": Reason(409, "Job has failed", "The job ended without a result. `error` is its own problem."),
    "JOB_FINISHED": Reason(409, "Job has finished", "A job that succeeded or failed can no longer be cancelled."),
    "JOB_ACTIVE": Reason(409, "Job is active", "Cancel the job before you delete it."),
    "JOB_EXPIRED": Reason(
        410, "Job has expired", "The job was deleted after its retention time. Post the request again."
    ),
    "ARTIFACT_NOT_READY": Reason(
        409, "Artifact not made yet", "Pictures and clouds follow the result. Retry after `Retry-After`."
    ),
    "RANGE_NOT_SATISFIABLE": Reason(416, "Range not satisfiable", "The range begins past the artifact's end."),
    # batches
    "BATCH_NOT_FOUND": Reason(404, "No such batch", "The id is unknown, or the batch is gone. Post its lines again."),
    # what a job can end with
    "NO_SURFACE_IN_DETECTION": Reason(
        422, "No surface in the detection", "Too few surface points were found in the box. Check the box, or the scene."
    ),
    "NO_SURFACE_IN_OBJECT": Reason(422, "No surface in the object", "The object's field has no zero level."),
    "NO_INITIAL_TRANSFORM": Reason(
        422, "No initial transform", "No initial transform was found. Object and scene may have no shape in common."
    ),
    "FIELD_IMPORT_TIMEOUT": Reason(
        422,
        "Import took too long",
        "A job waited too long for the import of one of its fields. An import that is too slow is `IMPORT_TIMEOUT`.",
    ),
    "JOB_TIMEOUT": Reason(500, "Job took too long", "The job exceeded its time and was stopped."),
    "WORKER_LOST": Reason(500, "Worker lost", "The worker vanished twice while it ran this job. Post it again."),
    "OUT_OF_MEMORY": Reason(
        500,
        "Out of memory",
        "The job needed more memory than the worker has, or than one job may have (`limit_bytes`).",
    ),
    "JOB_DISK_LIMIT": Reason(
        500, "Job over its disk space", "The job wrote more than one job may; `limit_bytes` says how much."
    ),
    # the service itself
    "NOT_READY": Reason(503, "Not ready", "`checks` says which part of the service is missing."),
    "RECORD_UNREADABLE": Reason(
        503,
        "Record unreadable",
        "The record is damaged, or of a later release. The operator knows; a damaged job may be asked for anew.",
    ),
    "STORAGE_UNAVAILABLE": Reason(
        503, "Storage unavailable", "The storage or the record store does not answer. Retry later."
    ),
    "INTERNAL": Reason(500, "Internal error", "The service failed. Its log has the error under the request id."),
}


# The problem object (RFC 9457) of a reason: what a record keeps, and what an answer carries.

_ENGINE_STATUS = 422


def problem_document(reason: str, detail: str | None = None, *, hint: str | None = None, **more: Any) -> dict[str, Any]:
    """The members of a problem. A reason that is not in REASONS is one of the engine's, which are about the input."""
    known = REASONS.get(reason)
    hint = hint or hint_of(reason)
    return {
        "type": f"/docs#{reason}",
        "title": known.title if known is not None else reason.replace("_", " ").capitalize(),
        "status": known.status if known is not None else _ENGINE_STATUS,
        "reason": reason,
        "detail": detail if detail is not None else known.meaning if known is not None else "",
        **({} if hint is None else {"hint": hint}),
        **more,
    }


def whole_problem(error: dict[str, Any]) -> dict[str, Any]:
    """A stored problem with every member that a problem has."""
    return problem_document(str(error.get("reason", "INTERNAL"))) | error
