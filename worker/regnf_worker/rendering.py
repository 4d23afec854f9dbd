"""The work of a rendering job: every field that its edits name, then the engine."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from regnf_core.rendering.request import RenderRequest
from regnf_state.ownership import sha256_of
from regnf_state.records import FieldRecord
from regnf_worker.engine import Engine
from regnf_worker.fields import Fields
from regnf_worker.heartbeat import Heartbeat


def render(
    engine: Engine,
    request: RenderRequest,
    fields: Fields,
    scene: FieldRecord,
    objects: Sequence[FieldRecord],
    heartbeat: Heartbeat,
    folder: Path,
) -> list[str]:
    """Have the engine render what the request asks for; the names of the artifacts in ``folder``."""
    opened = {sha256_of(one.sha256): partial(fields.file, one.sha256) for one in objects}
    return engine.render(fields.file(scene.sha256), opened, request, heartbeat.report, folder)
