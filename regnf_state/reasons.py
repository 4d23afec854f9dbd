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
    "MALFORMED_REQUEST": Reason(400, "Malformed request", "The request's head or the framing of its body is no HTTP."),
    "REQUEST_STALLED": Reason(408, "Request stalled", "The head or the body did not arrive in time. Nothing was kept."),
    "HEADERS_TOO_LARGE": Reason(431, "Headers too large", "The request's head has too many lines or too many bytes."),
    "TOO_MANY_CONNECTIONS": Reason(
        503, "Too many connections", "The service, or your address, has the maximum number of connections. Close some."
    ),
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
    "TOO_MANY_WRONG_TOKENS": Reason(
        429, "Too many wrong tokens", "Too many wrong tokens came from your address. A right one is taken at once."
    ),
    "NOT_FOUND": Reason(404, "Not found", "There is nothing under this address. `GET /` names every address."),
    "METHOD_NOT_ALLOWED": Reason(405, "Method not allowed", "The header `Allow` lists what this address answers to."),
    "RATE_LIMITED": Reason(
        429, "Too many calls", "You send requests faster than the service allows. See `Retry-After`."
    ),
    "TOO_MANY_WRITES": Reason(
        429,
        "Too many writes",
        "You post, change, cancel or delete faster than the service allows. Nothing was done. See `Retry-After`.",
    ),
    "TOO_MANY_REQUESTS_AT_ONCE": Reason(
        429, "Too many requests at once", "Wait until some of your requests have been answered, then repeat."
    ),
    "CONFLICT": Reason(409, "Conflict", "Another client changed it at the same time. Read it again, then repeat."),
    "REQUEST_TOO_LARGE": Reason(
        413, "Request too large", "The JSON or a text part exceeds the service's limit of bytes or of values."
    ),
    "UNSUPPORTED_MEDIA_TYPE": Reason(
        415, "Unsupported media type", "The `Content-Type` or `Content-Encoding` is not one this address takes."
    ),
    "INVALID_REQUEST": Reason(422, "Invalid request", "`errors` points at the members that are wrong."),
    # multipart
    "MALFORMED_MULTIPART": Reason(400, "Malformed multipart body", "The parts or their headers cannot be read."),
    "MISSING_PART": Reason(400, "Missing part", "A part that this address needs is not there."),
    "UNKNOWN_PART": Reason(400, "Unknown part", "The body has a part that this address does not know."),
    # uploads
    "INVALID_DIGEST": Reason(400, "Invalid digest", "A SHA-256 is 64 lower-case hexadecimal digits."),
    "DIGEST_MISMATCH": Reason(400, "Digest mismatch", "The bytes that arrived are not the bytes that were announced."),
    "UPLOAD_EMPTY": Reason(400, "Empty upload", "The upload has no bytes."),
    "UPLOAD_INCOMPLETE": Reason(400, "Incomplete upload", "The body ended before its declared length."),
    "UPLOAD_TOO_LARGE": Reason(413, "Upload too large", "The file exceeds the service's limit. Nothing was kept."),
    "UPLOAD_OFFSET_MISMATCH": Reason(
        409,
        "Another piece is expected",
        "The piece does not begin where the upload stopped: `offset` says how many bytes have arrived.",
    ),
    "UPLOAD_NOT_FINISHED": Reason(
        409, "Upload not finished", "The file's pieces are not all here: `offset` says how many bytes have arrived."
    ),
    "TOO_MANY_PIECES": Reason(409, "Too many pieces", "The upload has too many pieces. Send larger ones."),
    "FIELD_NOT_RECOGNIZED": Reason(
        415, "Not a field file", "The file is not a field in any format that the service reads."
    ),
    "TOO_MANY_UPLOADS": Reason(
        429, "Too many uploads at once", "Wait until one of your uploads has ended, then repeat."
    ),
    "QUOTA_STORED_BYTES": Reason(
        403, "Quota of bytes used up", "Your fields use all the bytes that you may store. Delete some."
    ),
    "QUOTA_FIELDS": Reason(403, "Quota of fields used up", "You have the maximum number of fields. Delete some."),
    "QUOTA_IMPORTS": Reason(
        429, "Quota of imports used up", "You have the maximum number of imports that wait or run. Wait for one to end."
    ),
    "STORAGE_FULL": Reason(507, "Storage full", "No space is left for the bytes. Nothing was kept."),
    # fields
    "FIELD_NOT_FOUND": Reason(404, "No such field", "Upload it with `PUT /fields/{sha256}` first."),
    "FIELD_PREVIEW_NOT_FOUND": Reason(
        404,
        "No picture",
        "Only fields that are `ready` have a picture, and not all of them do. With `Retry-After` it is still to be "
        "made. Of a rejected field, candidates have one while its upload is kept.",
    ),
    "FIELD_MESH_NOT_FOUND": Reason(
        404,
        "No mesh",
        "Only fields that are `ready` have a mesh to look at, and not those that are too slow for it. With "
        "`Retry-After` it is still to be made.",
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
    "LIBRARY_ENTRY_INVALID": Reason(
        422, "Invalid library entry", "`detail` says what is wrong with the name, a tag, the note or the symmetry."
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
    "INITIAL_TRANSFORM_UNSUPPORTED": Reason(
        422,
        "Initial transform unsupported",
        "Only the preset `robust` starts from a given transform, and only with one `object`. Leave it out.",
    ),
    "LIBRARY_SEARCH_UNSUPPORTED": Reason(
        422,
        "Library search unsupported",
        "The preset `paper` registers one object. Name it as `object`, or take the preset `robust`.",
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
    "QUOTA_ACTIVE_JOBS": Reason(
        429, "Quota of jobs used up", "You have the maximum number of active jobs. Wait for one to end."
    ),
    "QUOTA_WEBHOOKS": Reason(409, "Quota of webhooks used up", "The job has 16 webhooks, or 4 kB. Ask for its state."),
    # renderings
    "CAMERA_INVALID": Reason(
        422,
        "Invalid camera",
        "A camera's pose, lens or size is none, or its path has no frame. `detail` says which.",
    ),
    "CAMERA_IN_MATTER": Reason(
        422,
        "Camera in matter",
        "A camera stands inside of something. Move it, or set the option `cut_away`.",
    ),
    "COLORS_MISSING": Reason(
        422,
        "No colors",
        "Colors are asked for, and no field has any. Let them be shaded: `coloring` `auto`.",
    ),
    "EDIT_INVALID": Reason(
        422,
        "Invalid edit",
        "The edit is no substitution, replacement, removal or insertion, or its job is no registration in this scene. "
        "`detail` says which.",
    ),
    "EDIT_POSE_REJECTED": Reason(
        422,
        "Pose was rejected",
        "The registration that an edit names rejected its pose. To use it all the same, give `object` and "
        "`T_object_scene` instead of `job`.",
    ),
    "EDIT_OUTSIDE_SCENE": Reason(
        422,
        "Edit outside the scene",
        "What the edit changes lies outside of the scene's bounds. Check the transform's direction and the units.",
    ),
    "EDITS_OVERLAP": Reason(
        422,
        "Edits overlap",
        "Two edits take away the same thing, or put matter in one place. Leave one out.",
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
    "TOO_MANY_PAIRS": Reason(
        413, "Too many pairs", "The batch has more lines than the service takes. Send them as several batches."
    ),
    "QUOTA_BATCHES": Reason(
        429, "Quota of batches used up", "You have the maximum number of batches, and none has ended. Wait for one."
    ),
    # what a job can end with
    "NO_SURFACE_IN_DETECTION": Reason(
        422, "No surface in the detection", "Too few surface points were found in the box. Check the box, or the scene."
    ),
    "NO_SURFACE_IN_OBJECT": Reason(422, "No surface in the object", "The object's field has no zero level."),
    "NO_INITIAL_TRANSFORM": Reason(
        422, "No initial transform", "No initial transform was found. Object and scene may have no shape in common."
    ),
    "CANCELLED": Reason(409, "Cancelled", "The job stopped because it was cancelled."),
    "FIELD_IMPORT_TIMEOUT": Reason(
        422,
        "Import took too long",
        "A job waited too long for the import of one of its fields. An import that is too slow is `IMPORT_TIMEOUT`.",
    ),
    "JOB_TIMEOUT": Reason(500, "Job took too long", "The job exceeded its time and was stopped."),
    "WORKER_LOST": Reason(500, "Worker lost", "The worker vanished twice while it ran this job. Post it again."),
    "OUT_OF_MEMORY": Reason(500, "Out of memory", "The job needed more memory than the worker has."),
    "JOB_MEMORY_LIMIT": Reason(
        500, "Job over its memory", "The job needed more memory than one job may have; `limit_bytes` says how much."
    ),
    "JOB_DISK_LIMIT": Reason(
        500, "Job over its disk space", "The job wrote more than one job may; `limit_bytes` says how much."
    ),
    # the service itself
    "NOT_READY": Reason(503, "Not ready", "`checks` says which part of the service is missing."),
    "RECORDS_FULL": Reason(
        507, "Records full", "The record store keeps its last room for what goes on. Delete jobs, or retry later."
    ),
    "RECORD_UNREADABLE": Reason(
        503,
        "Record unreadable",
        "The record is damaged, or of a later release. The operator knows; a damaged job may be asked for anew.",
    ),
    "STORE_UNAVAILABLE": Reason(503, "Records unavailable", "The record store does not answer. Retry later."),
    "STORAGE_UNAVAILABLE": Reason(503, "Storage unavailable", "The blob storage does not answer. Retry later."),
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
