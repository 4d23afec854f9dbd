"""The result document of a rendering."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.rendering.request import RenderRequest
from regnf_state.manifest import EDITED_FIELD

if TYPE_CHECKING:
    from regnf_core.rendering.job import RenderReport


def write_result(folder: Path, request: RenderRequest, report: RenderReport, engine: dict[str, Any]) -> list[str]:
    """Write ``result.json`` beside the files of a rendering; the names of all that is to be kept."""
    names = [one.name for one in report.artifacts]
    document = {
        "frames": request.frames,
        "size": list(request.image_size),
        "depth_unit": report.depth_unit,
        "seconds": report.seconds,
        "field": _digest(folder / EDITED_FIELD) if EDITED_FIELD in names else None,
        "seed": request.seed,
        "options": asdict(request.options),
        "engine": engine,
        "artifacts": [asdict(one) for one in report.artifacts],
    }
    (folder / "result.json").write_text(json.dumps(document), encoding="utf-8")
    return [*names, "result.json"]


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
