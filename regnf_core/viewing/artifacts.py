"""The files of one registration: result document, history, point clouds, residuals, picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.document import DecidingSurface, IterationRecord, RegistrationResult, json_number, result_document
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.schema.similarity import local_origin
from regnf_core.viewing.difference_panel import DIFFERENCE, STATE_COLORS
from regnf_core.viewing.registration_picture import FAST, OBJECT_COLOR, SCENE_COLOR, registration_picture

# Point clouds as binary little-endian PLY, which every viewer reads.

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar"}


def write_ply(
    path: Path,
    points: NDArray[np.float32 | np.float64],
    normals: NDArray[Any],
    colors: NDArray[np.uint8],
    **labels: NDArray[Any],
) -> None:
    """Write points (N, 3) in their own precision, unit normals (N, 3), colors (N, 3), 0 to 255, and labels (N,), whole
    numbers as small, by their names."""
    columns = {
        **dict.fromkeys(("x", "y", "z"), "f8" if points.dtype == np.float64 else "f4"),
        **dict.fromkeys(("nx", "ny", "nz"), "f4"),
        **dict.fromkeys(("red", "green", "blue", *labels), "u1"),
    }
    vertices = np.empty(points.shape[0], dtype=[(name, f"<{code}") for name, code in columns.items()])
    for name, values in zip(columns, [*points.T, *normals.T, *colors.T, *labels.values()], strict=True):
        vertices[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {vertices.size}",
        *(f"property {_TYPES[code]} {name}" for name, code in columns.items()),
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes())


def trace_document(trace: list[IterationRecord]) -> list[dict[str, Any]]:
    """One plain entry an iteration: the record's members, and T_object_scene as a row-major 4x4 matrix."""
    return [
        {name: json_number(value) for name, value in vars(record).items() if name != "T_object_scene"}
        | {"T_object_scene": {"matrix": record.T_object_scene.matrix().tolist()}}
        for record in trace
    ]


# The files of one registration, written into a folder.

CONTEXT_COLOR = (0.80, 0.82, 0.85)
_CONTEXT, PICTURE = "context_points.ply", "preview.png"
CLOUDS = ("scene_points.ply", "object_points.ply", "aligned.ply", "residuals.npz", _CONTEXT)
"""What ``write_clouds`` may write, beside ``DIFFERENCE`` where the result has a deciding surface."""


def write_artifacts(
    result: RegistrationResult,
    directory: Path,
    truth: Sim3 | None = None,
    **said: Any,
) -> list[str]:
    """Write every artifact of ``result`` into the existing ``directory`` and return the files' names.

    truth, said: for the result document, as ``result_document``.
    """
    return write_pictures(result, directory) + write_result(result, directory, truth, **said)


def write_result(result: RegistrationResult, directory: Path, truth: Sim3 | None = None, **said: Any) -> list[str]:
    """What was found: trace.json, T_scene_object.npy (4x4), considered.npz (what the held-out samples say of each pose
    that was judged, if the result has it), result.json. said: as ``result_document``.
    """
    _write_json(directory / "trace.json", trace_document(result.trace))
    np.save(directory / "T_scene_object.npy", result.T_scene_object.matrix().double().cpu().numpy())
    document = result_document(result, truth, result.scene_samples.points.device, **said)
    _write_json(directory / "result.json", document)
    names = ["trace.json", "T_scene_object.npy", "result.json"]
    if result.considered is None:
        return names
    arrays: dict[str, Any] = {n: _numbers(getattr(result.considered, n)) for n in ("scene_points", "object_points")}
    for name in ("scene_signs", "object_signs"):
        arrays[name] = getattr(result.considered, name).cpu().numpy()
    np.savez(directory / "considered.npz", **arrays)
    return [*names, "considered.npz"]


def write_pictures(result: RegistrationResult, directory: Path) -> list[str]:
    """What people look at, of a result with clouds: what ``write_clouds`` writes, and preview.png."""
    names = write_clouds(result, directory)
    registration_picture(result).save(directory / PICTURE, compress_level=FAST)
    return [*names, PICTURE]


def write_clouds(result: RegistrationResult, directory: Path) -> list[str]:
    """Of a result with clouds: scene_points.ply (scene frame), object_points.ply (object frame), aligned.ply (both,
    scene frame, colored by source), residuals.npz, context_points.ply (the scene around the detection, if the result
    has it), difference.ply (where a search's first two candidates differ, scene frame, colored by what the scene says
    there, if the result has it). The picture can be drawn of them:
    ``regnf_core.viewing.registration_picture.stored_picture``.
    """
    scene, obj = result.scene_samples, result.object_samples
    placed = obj.transformed(result.T_scene_object)
    _write_cloud(directory / "scene_points.ply", (scene, SCENE_COLOR))
    _write_cloud(directory / "object_points.ply", (obj, OBJECT_COLOR))
    _write_cloud(directory / "aligned.ply", (scene, SCENE_COLOR), (placed, OBJECT_COLOR))
    arrays: dict[str, Any] = {name: _numbers(value) for name, value in result.residuals.items()}
    np.savez(directory / "residuals.npz", **arrays)
    names = [name for name in CLOUDS if name != _CONTEXT]
    if result.surroundings is not None and len(result.surroundings.points):
        _write_cloud(directory / _CONTEXT, (result.surroundings, CONTEXT_COLOR))
        names.append(_CONTEXT)
    if result.deciding is not None:
        _write_difference(directory / DIFFERENCE, result.deciding)
        names.append(DIFFERENCE)
    return names


def _write_difference(path: Path, deciding: DecidingSurface) -> None:
    states = deciding.states.cpu().numpy()
    colors = (255 * STATE_COLORS[states]).round().astype(np.uint8)
    samples, whose = deciding.samples, 1 + deciding.of_other.cpu().numpy()
    write_ply(path, _numbers(samples.points), _numbers(samples.normals), colors, candidate=whose, state=states)


def _write_cloud(path: Path, *parts: tuple[SurfaceSamples, tuple[float, float, float]]) -> None:
    points = np.concatenate([_numbers(samples.points) for samples, _ in parts])
    normals = np.concatenate([_numbers(samples.normals) for samples, _ in parts])
    colors = np.concatenate([np.tile(np.array(color), (len(samples.points), 1)) for samples, color in parts])
    write_ply(path, points, normals, (255 * colors).round().astype(np.uint8))


def _write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, allow_nan=False, separators=(",", ":")), encoding="utf-8")


def _numbers(values: Tensor) -> np.ndarray[Any, np.dtype[np.float32 | np.float64]]:
    """In single precision, unless they are places too far from the origin for it."""
    array = values.detach().cpu()
    far = array.ndim == 2 and len(array) > 0 and local_origin([array.amin(0).tolist(), array.amax(0).tolist()])
    found: np.ndarray[Any, np.dtype[np.float32 | np.float64]] = (array.double() if far else array.float()).numpy()
    return found
