"""The files of one registration, written into a folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from regnf_core.field_notes import FieldNotes
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.geometry.symmetry import Symmetries
from regnf_core.result import RegistrationResult
from regnf_core.viewing.document import result_document, trace_document
from regnf_core.viewing.ply import write_ply
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR, registration_picture

CONTEXT_COLOR = (0.80, 0.82, 0.85)
_ALWAYS = (
    "scene_points.ply",
    "object_points.ply",
    "aligned.ply",
    "residuals.npz",
    "trace.json",
    "transform.npy",
    "preview.png",
    "result.json",
)


def write_artifacts(
    result: RegistrationResult,
    directory: Path,
    truth: Sim3 | None = None,
    symmetries: Symmetries | None = None,
    object_name: str | None = None,
    candidates: list[dict[str, Any]] | None = None,
    fields: Mapping[str, FieldNotes] | None = None,
) -> list[str]:
    """Write every artifact of ``result`` into the existing ``directory`` and return the files' names.

    ``truth``, ``symmetries``, ``object_name``, ``candidates`` and ``fields`` are for the result document.

    scene_points.ply (scene frame), object_points.ply (object frame), aligned.ply (both, scene frame, colored by
    source), context_points.ply (the scene around the detection, if the result has it), residuals.npz,
    trace.json, transform.npy (T_object_scene, 4x4), preview.png, result.json.
    """
    scene, obj = result.scene_samples, result.object_samples
    placed = obj.transformed(result.T_object_scene.inverse())
    _write_cloud(directory / "scene_points.ply", (scene, SCENE_COLOR))
    _write_cloud(directory / "object_points.ply", (obj, OBJECT_COLOR))
    _write_cloud(directory / "aligned.ply", (scene, SCENE_COLOR), (placed, OBJECT_COLOR))
    names = list(_ALWAYS)
    if result.surroundings is not None and len(result.surroundings.points):
        _write_cloud(directory / "context_points.ply", (result.surroundings, CONTEXT_COLOR))
        names.append("context_points.ply")
    arrays: dict[str, Any] = {name: _float32(value) for name, value in result.residuals.items()}
    np.savez(directory / "residuals.npz", **arrays)
    _write_json(directory / "trace.json", trace_document(result.trace))
    np.save(directory / "transform.npy", result.T_object_scene.matrix().double().cpu().numpy())
    registration_picture(result).save(directory / "preview.png")
    device = scene.points.device
    said: dict[str, Any] = {"object_name": object_name, "candidates": candidates, "fields": fields}
    document = result_document(result, truth, symmetries, device, **said)
    _write_json(directory / "result.json", document)
    return names


def _write_cloud(path: Path, *parts: tuple[SurfaceSamples, tuple[float, float, float]]) -> None:
    points = np.concatenate([_float32(samples.points) for samples, _ in parts])
    normals = np.concatenate([_float32(samples.normals) for samples, _ in parts])
    colors = np.concatenate(
        [
            np.tile((255 * np.array(color)).round().astype(np.uint8), (len(samples.points), 1))
            for samples, color in parts
        ]
    )
    write_ply(path, points, normals, colors)


def _write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, allow_nan=False, separators=(",", ":")), encoding="utf-8")


def _float32(values: Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
    array: np.ndarray[Any, np.dtype[np.float32]] = values.detach().float().cpu().numpy()
    return array
