"""The work of a registration job: models of its objects, then the engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.field_notes import FieldNotes
from regnf_state.ownership import sha256_of
from regnf_state.records import FieldRecord
from regnf_state.registration_request import RegistrationRequest
from regnf_worker.context import Context
from regnf_worker.engine import Candidate, Engine, Made
from regnf_worker.fields import Fields
from regnf_worker.heartbeat import Heartbeat
from regnf_worker.models import ObjectModels


def register(
    context: Context,
    engine: Engine,
    request: RegistrationRequest,
    fields: Fields,
    scene: FieldRecord,
    objects: Sequence[FieldRecord],
    heartbeat: Heartbeat,
    folder: Path,
) -> Made:
    """Have the engine do what the request asks for, artifacts into ``folder``."""
    options, scene_file = request.options, fields.file(scene.sha256)
    notes = {sha256_of(one.sha256): FieldNotes.of_report(one.report) for one in objects}
    notes["scene"] = FieldNotes.of_report(scene.report)
    if request.candidates is not None:
        models = ObjectModels(context, engine, options, folder)
        candidates = [_candidate(models, one, fields, heartbeat) for one in objects]
        if all(one.model is None for one in candidates):
            raise NoSurfaceError("none of the candidates is usable as an object", reason="NO_SURFACE_IN_OBJECT")
        return engine.search(scene_file, candidates, request, heartbeat.report, folder, notes)
    (one,) = objects
    object_file, model = fields.file(one.sha256), None
    if options.preset == "robust":
        model = ObjectModels(context, engine, options, folder).of(one, lambda: object_file)
    named = replace(request, object=sha256_of(one.sha256))
    return engine.register(scene_file, object_file, model, named, heartbeat.report, folder, notes)


def _candidate(models: ObjectModels, field: FieldRecord, fields: Fields, heartbeat: Heartbeat) -> Candidate:
    """One candidate with its model; one that is no object is unusable, not the end of the search."""
    heartbeat.report("loading", 0.0)
    sha256 = field.sha256
    try:
        model = models.of(field, lambda: fields.file(sha256))
    except (NoSurfaceError, InvalidInputError) as error:
        return Candidate(sha256_of(sha256), lambda: fields.file(sha256), None, error.reason)
    return Candidate(sha256_of(sha256), lambda: fields.file(sha256), model)
