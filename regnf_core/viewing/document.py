"""The result document: everything about a registration that fits into JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import verdict_hint, verdict_in_words
from regnf_core.field_notes import FieldNotes
from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.metrics import Symmetries, errors_against_truth, paper_errors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.result import Alternative, Considered, ConsideredPose, IterationRecord, RegistrationResult
from regnf_core.schema.similarity import local_origin
from regnf_core.version import __version__
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR, registration_picture

if TYPE_CHECKING:
    from regnf_core.library import Candidate


# Point clouds as binary little-endian PLY, which every viewer reads.

_TYPES = {"f4": "float", "f8": "double", "u1": "uchar"}


def write_ply(
    path: Path, points: NDArray[np.float32 | np.float64], normals: NDArray[Any], colors: NDArray[np.uint8]
) -> None:
    """Write points (N, 3) in their own precision, unit normals (N, 3) and colors (N, 3), 0 to 255."""
    columns = {
        **dict.fromkeys(("x", "y", "z"), "f8" if points.dtype == np.float64 else "f4"),
        **dict.fromkeys(("nx", "ny", "nz"), "f4"),
        **dict.fromkeys(("red", "green", "blue"), "u1"),
    }
    vertices = np.empty(points.shape[0], dtype=[(name, f"<{code}") for name, code in columns.items()])
    for name, values in zip(columns, np.hstack([points.astype(np.float64), normals, colors]).T, strict=True):
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


# The uncertainty of a pose in degrees, scene units and percent, from its covariance.

COVARIANCE_ORDERING = ("omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s")
"""What the rows and columns of a covariance belong to: see :attr:`regnf_core.result.RegistrationResult.covariance`."""


def center_covariance(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> Tensor:
    """(3, 3) float64, scene frame and units: of the place of an object's point ``center`` (3,), object frame.

    The point lies at p = R^T (c - t) / s. To first order a perturbation moves it by R^T ((c - t) x omega - dt -
    (c - t) log_s) / s. The lever arm c - t cancels what the translation's entries owe to a far origin, so all of it is
    done in float64.
    """
    arm = center.double() - T_object_scene.translation.double()
    J = torch.cat([skew(arm), -torch.eye(3, dtype=torch.float64), -arm[:, None]], 1)
    J = T_object_scene.rotation.double().mT @ J / T_object_scene.scale.double()
    found: Tensor = J @ covariance.double() @ J.mT
    return found


def uncertainty(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> dict[str, Any]:
    """Standard deviations from the covariance (7, 7); null for an entry that is not a variance.

    center_scene: of the place of the object's center (3,), object frame, along the scene's x, y, z, scene units ·
    rotation_deg: degrees about the object frame's x, y, z · scale_percent: of the scale.
    """
    variances = covariance.diagonal().tolist()
    degrees = [_root(variance) for variance in variances[:3]]
    growth = _root(variances[6])
    return {
        "center_scene": [_root(v) for v in center_covariance(covariance, T_object_scene, center).diagonal().tolist()],
        "rotation_deg": [None if sigma is None else math.degrees(sigma) for sigma in degrees],
        "scale_percent": None if growth is None else 100.0 * growth,
    }


def _root(variance: float) -> float | None:
    return math.sqrt(variance) if 0.0 <= variance < math.inf else None


def result_document(
    result: RegistrationResult,
    truth: Sim3 | None = None,
    symmetries: Symmetries | None = None,
    device: torch.device | str = "cpu",
    *,
    object_name: str | None = None,
    candidates: list[dict[str, Any]] | None = None,
    fields: Mapping[str, FieldNotes] | None = None,
) -> dict[str, Any]:
    """Plain JSON values of the result; with ``truth``, a T_object_scene, the metrics hold the errors against it.

    ``symmetries`` are the object's: rotation error and MSSD are the smallest over them. ``device``: of the computation.
    ``object_name``: the object that was registered. ``candidates``: of :func:`ranking_document`, after a search.
    ``fields``: what is known of the imports of scene and object, by these names.
    """
    metrics = dict(result.metrics)
    if truth is not None:
        metrics |= errors_against_truth(
            result.T_object_scene, truth, result.object_samples.points, symmetries, result.center_object
        )
        if result.options.get("preset") == "paper":
            metrics |= paper_errors(result.T_object_scene, truth)
    return {
        "verdict": result.verdict,
        "verdict_reason": result.verdict_reason,
        "verdict_detail": verdict_in_words(result.verdict_reason, result.verdict_limit),
        "verdict_hint": verdict_hint(result.verdict_reason, result.options),
        "probability": None if result.probability is None else _json_number(result.probability),
        "T_scene_object": result.T_scene_object.to_dict(),
        "T_object_scene": result.T_object_scene.to_dict(),
        "center_scene": result.center_scene.tolist(),
        "center_object": result.center_object.tolist(),
        "T_object_scene_initial": result.T_object_scene_initial.to_dict(),
        "alternatives": [_alternative(other) for other in result.alternatives],
        "considered": None if result.considered is None else [_considered(one) for one in result.considered.poses],
        **_covariance(result),
        "symmetry": None if result.symmetry is None else asdict(result.symmetry),
        "metrics": {name: _json_number(value) for name, value in metrics.items()},
        "object": object_name,
        "candidates": candidates,
        "fields": None if fields is None else {name: notes.to_dict() for name, notes in fields.items()},
        "seed": result.seed,
        "options": result.options,
        "engine": {
            "name": "regnf",
            "version": __version__,
            "device": str(device),
            "torch": torch.__version__,
        },
    }


def ranking_document(ranking: Sequence[Candidate], unusable: Mapping[str, str]) -> list[dict[str, Any]]:
    """A search's candidates as plain values, the best first, then those ``unusable``: their names and reasons."""
    ranked: list[dict[str, Any]] = [
        {
            "object": one.name,
            "stage": one.stage,
            "score": _json_number(one.score),
            "verdict": one.verdict,
            "verdict_reason": one.verdict_reason,
            "probability": one.probability,
            "T_scene_object": None if one.T_scene_object is None else one.T_scene_object.to_dict(),
            "T_object_scene": None if one.T_object_scene is None else one.T_object_scene.to_dict(),
        }
        for one in ranking
    ]
    nothing = dict.fromkeys(("score", "verdict", "probability", "T_scene_object", "T_object_scene"))
    return ranked + [
        {"object": name, "stage": "unusable", **nothing, "verdict_reason": reason} for name, reason in unusable.items()
    ]


def trace_document(trace: list[IterationRecord]) -> list[dict[str, Any]]:
    """One plain entry an iteration: the loss, its parts, the kernel, and T_object_scene as a row-major 4x4 matrix."""
    return [
        {
            "iteration": record.iteration,
            "loss": _json_number(record.loss),
            "residual_scene": _json_number(record.residual_scene),
            "residual_object": _json_number(record.residual_object),
            "regularizer": _json_number(record.regularizer),
            "kernel_shape": record.kernel_shape,
            "kernel_scale": record.kernel_scale,
            "scene_samples": record.scene_samples,
            "object_samples": record.object_samples,
            "T_object_scene": {"matrix": record.T_object_scene.matrix().tolist()},
        }
        for record in trace
    ]


def _covariance(result: RegistrationResult) -> dict[str, Any]:
    covariance = result.covariance
    if covariance is None:
        return {"covariance": None, "covariance_ordering": None, "uncertainty": None}
    rows = [[_json_number(value) for value in row] for row in covariance.tolist()]
    return {
        "covariance": rows,
        "covariance_ordering": list(COVARIANCE_ORDERING),
        "uncertainty": uncertainty(covariance, result.T_object_scene, result.center_object),
    }


def _considered(one: ConsideredPose) -> dict[str, Any]:
    return {
        **_both_ways(one),
        "reason": one.reason,
        "detail": verdict_in_words(one.reason, one.limit),
        "metrics": {name: _json_number(value) for name, value in one.metrics.items()},
    }


def _alternative(other: Alternative) -> dict[str, Any]:
    return {**_both_ways(other), "score": other.score, "relation": other.relation}


def _both_ways(pose: Alternative | ConsideredPose) -> dict[str, Any]:
    return {"T_scene_object": pose.T_scene_object.to_dict(), "T_object_scene": pose.T_object_scene.to_dict()}


def _json_number(value: float) -> float | None:
    """None for NaN and infinity, which JSON cannot hold."""
    return value if math.isfinite(value) else None


# The files of one registration, written into a folder.

CONTEXT_COLOR = (0.80, 0.82, 0.85)
_CLOUDS = ("scene_points.ply", "object_points.ply", "aligned.ply", "residuals.npz")
_CONTEXT, _PICTURE = "context_points.ply", "preview.png"
PICTURES = (*_CLOUDS, _CONTEXT, _PICTURE)
"""What ``write_pictures`` may write."""


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
    """
    said: dict[str, Any] = {"object_name": object_name, "candidates": candidates, "fields": fields}
    return write_pictures(result, directory) + write_result(result, directory, truth, symmetries, **said)


def write_result(
    result: RegistrationResult,
    directory: Path,
    truth: Sim3 | None = None,
    symmetries: Symmetries | None = None,
    **said: Any,
) -> list[str]:
    """What was found: trace.json, T_scene_object.npy (4x4), considered.npz (what the held-out samples say of each pose
    that was judged, if the result has it), result.json. said: as ``result_document``.
    """
    _write_json(directory / "trace.json", trace_document(result.trace))
    np.save(directory / "T_scene_object.npy", result.T_scene_object.matrix().double().cpu().numpy())
    document = result_document(result, truth, symmetries, result.scene_samples.points.device, **said)
    _write_json(directory / "result.json", document)
    names = ["trace.json", "T_scene_object.npy", "result.json"]
    if result.considered is not None:
        _write_considered(directory / "considered.npz", result.considered)
        names.append("considered.npz")
    return names


def write_pictures(result: RegistrationResult, directory: Path) -> list[str]:
    """What people look at, of a result with clouds.

    scene_points.ply (scene frame), object_points.ply (object frame), aligned.ply (both, scene frame, colored by
    source), context_points.ply (the scene around the detection, if the result has it), residuals.npz, preview.png.
    """
    scene, obj = result.scene_samples, result.object_samples
    placed = obj.transformed(result.T_scene_object)
    _write_cloud(directory / "scene_points.ply", (scene, SCENE_COLOR))
    _write_cloud(directory / "object_points.ply", (obj, OBJECT_COLOR))
    _write_cloud(directory / "aligned.ply", (scene, SCENE_COLOR), (placed, OBJECT_COLOR))
    names = list(_CLOUDS)
    if result.surroundings is not None and len(result.surroundings.points):
        _write_cloud(directory / _CONTEXT, (result.surroundings, CONTEXT_COLOR))
        names.append(_CONTEXT)
    arrays: dict[str, Any] = {name: _numbers(value) for name, value in result.residuals.items()}
    np.savez(directory / "residuals.npz", **arrays)
    registration_picture(result).save(directory / _PICTURE)
    return [*names, _PICTURE]


def _write_considered(path: Path, considered: Considered) -> None:
    """The held-out samples, and what they say of each pose that was judged."""
    points = {name: _numbers(getattr(considered, name)) for name in ("scene_points", "object_points")}
    signs = {name: getattr(considered, name).cpu().numpy() for name in ("scene_signs", "object_signs")}
    arrays: dict[str, Any] = points | signs
    np.savez(path, **arrays)


def _write_cloud(path: Path, *parts: tuple[SurfaceSamples, tuple[float, float, float]]) -> None:
    points = np.concatenate([_numbers(samples.points) for samples, _ in parts])
    normals = np.concatenate([_numbers(samples.normals) for samples, _ in parts])
    colors = np.concatenate(
        [
            np.tile((255 * np.array(color)).round().astype(np.uint8), (len(samples.points), 1))
            for samples, color in parts
        ]
    )
    write_ply(path, points, normals, colors)


def _write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, allow_nan=False, separators=(",", ":")), encoding="utf-8")


def _numbers(values: Tensor) -> np.ndarray[Any, np.dtype[np.float32 | np.float64]]:
    """In single precision, unless they are places too far from the origin for it."""
    array = values.detach().cpu()
    far = array.ndim == 2 and len(array) > 0 and local_origin([array.amin(0).tolist(), array.amax(0).tolist()])
    found: np.ndarray[Any, np.dtype[np.float32 | np.float64]] = (array.double() if far else array.float()).numpy()
    return found
