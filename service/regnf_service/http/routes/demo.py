"""The demo: two fields and a detection to try the service with, where the operator has them (`regnf serve` does)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from starlette.responses import FileResponse, JSONResponse

from regnf_service.concurrency import blocking
from regnf_service.http.body import PrefixDep, ServicesDep
from regnf_service.http.routes.documentation import BINARY, get_and_head, refusals
from regnf_service.http.schemas.results import DemoDocument
from regnf_service.problem import Problem
from regnf_service.services import Services

router = APIRouter(tags=["service"])
_FIELDS = {"scene": "mix-room.safetensors", "object": "armchair.safetensors"}
_DETECTION = "detection.json"
_NO_DEMO = "This service has no demo files. `regnf serve` has them. Upload your own fields."


def _folder(services: Services) -> Path:
    folder = services.settings.demo_dir
    if folder is None or not all((folder / name).is_file() for name in (*_FIELDS.values(), _DETECTION)):
        raise Problem("NOT_FOUND", _NO_DEMO)
    return folder


@router.get("/demo", summary="Example fields", response_model=DemoDocument, responses=refusals("NOT_FOUND"))
@blocking
def get_demo(services: ServicesDep, prefix: PrefixDep) -> JSONResponse:
    """The addresses of two field files, which you can download and upload, and a detection of the object in the
    scene."""
    folder = _folder(services)
    files: dict[str, Any] = {
        part: {"name": name, "bytes": (folder / name).stat().st_size, "address": f"{prefix}/demo/{name}"}
        for part, name in _FIELDS.items()
    }
    return JSONResponse(files | {"detection": json.loads((folder / _DETECTION).read_text(encoding="utf-8"))})


@get_and_head(
    router,
    "/demo/{name}",
    summary="An example field file",
    response_class=FileResponse,
    responses={
        200: {"description": "The file.", "content": {"application/octet-stream": BINARY}},
        **refusals("NOT_FOUND"),
    },
)
@blocking
def get_demo_file(name: str, services: ServicesDep) -> FileResponse:
    """One of the files that `GET /demo` names."""
    folder = _folder(services)
    if name not in _FIELDS.values():
        raise Problem("NOT_FOUND", _NO_DEMO)
    return FileResponse(folder / name, media_type="application/octet-stream", headers={"Cache-Control": "no-cache"})
