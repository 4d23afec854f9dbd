"""The result document: everything about a registration that fits into JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch

from regnf_core.field_notes import FieldNotes
from regnf_core.geometry.metrics import errors_against_truth, paper_errors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.symmetry import Symmetries
from regnf_core.hints import verdict_hint
from regnf_core.result import Alternative, ConsideredPose, IterationRecord, RegistrationResult
from regnf_core.verdicts import verdict_in_words
from regnf_core.version import __version__
from regnf_core.viewing.uncertainty import COVARIANCE_ORDERING, uncertainty

if TYPE_CHECKING:
    from regnf_core.library import Candidate


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
