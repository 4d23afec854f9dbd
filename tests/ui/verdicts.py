"""What results of the preset `robust` carry besides the transform, made up for the page as the contract has it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from regnf_core.errors import HINTS
from tests.ui.synthetic import Synthetic, rotation, sim3_document, similarity

SIGMAS = [math.radians(0.4), math.radians(0.8), math.radians(0.2), 0.003, 0.001, 0.002, 0.005]
ORDERING = ["omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s"]
WARNING = "TRUNCATION_ASSUMED: taken for <b>8</b> voxels"
DETAIL = "Several poses match the data equally well: this one and the alternatives."


def ambiguous_result(data: Synthetic) -> dict[str, Any]:
    """The made-up result with two more poses, a covariance, a symmetry and options."""
    correlation = np.eye(7) + 0.3 * (np.eye(7, k=3) + np.eye(7, k=-3))
    covariance = correlation * np.outer(SIGMAS, SIGMAS)
    return data.result | {
        "verdict": "ambiguous",
        "verdict_reason": "SEVERAL_POSES_AGREE",
        "verdict_detail": DETAIL,
        "verdict_hint": HINTS["SEVERAL_POSES_AGREE"],
        "alternatives": [
            _alternative(data, [0, 0, 1], 3.0, 0.043, "172 degrees about z"),
            _alternative(data, [1, 0, 0], math.pi, 0.071, "180 degrees about x"),
        ],
        "covariance": covariance.tolist(),
        "covariance_ordering": ORDERING,
        "uncertainty": {
            "center_scene": SIGMAS[3:6],
            "rotation_deg": [0.4, 0.8, 0.2],
            "scale_percent": 100 * SIGMAS[6],
        },
        "fields": {
            "scene": {"family": "neus", "settings": None, "warnings": [WARNING]},
            "object": {"family": None, "settings": None, "warnings": []},
        },
        "symmetry": {"order": 2, "axis": [-0.001, 0.0, 1.0], "continuous": False},
        "metrics": data.result["metrics"] | {"score": 0.041},
        "options": {
            "preset": "robust",
            "sampling": {"views": 5},
            "up_axis": None,
            "robust": {"rotations": 600, "inlier_distance": 0.015},
        },
    }


def judged_result(data: Synthetic) -> dict[str, Any]:
    """The made-up result with one more pose that was judged, and rejected."""

    def judged(T: dict[str, Any], reason: str, probability: float, free: float) -> dict[str, Any]:
        metrics = {"probability": probability, "free_space_violations": free, "score": None}
        return {"T_object_scene": T, "reason": reason, "detail": f"<b>{reason}</b>", "metrics": metrics}

    tipped = sim3_document(similarity(1.0, rotation([1, 0, 0], 1.0), np.zeros(3)) @ data.T_object_scene)
    poses = [judged(data.result["T_object_scene"], "SURFACES_AGREE", 0.97, 0.0)]
    poses.append(judged(tipped, "FREE_SPACE_VIOLATED", 0.02, 0.4))
    listed = [*data.result["artifacts"], {"name": "considered.npz"}]
    return data.result | {"considered": poses, "artifacts": listed}


def searched_result(data: Synthetic) -> dict[str, Any]:
    """The made-up result as the best of a search among twelve objects."""

    def candidate(number: int, stage: str, score: float | None, verdict: str | None = None) -> dict[str, Any]:
        reason = "NO_SURFACE_IN_OBJECT" if stage == "unusable" else None
        return {"object": f"{number:02x}" * 32, "stage": stage, "score": score, "verdict": verdict,
                "verdict_reason": reason, "T_object_scene": None}  # fmt: skip

    ranking = [
        candidate(0xA0, "refined", 0.021, "registered"),
        candidate(0xA1, "refined", 0.34, "rejected"),
        *(candidate(0xB0 + k, "coarse", 0.4 + k / 100) for k in range(6)),
        *(candidate(0xC0 + k, "signature", 0.2) for k in range(3)),
        candidate(0xD0, "unusable", None),
    ]
    return data.result | {"object": ranking[0]["object"], "candidates": ranking}


def _alternative(data: Synthetic, axis: list[float], angle: float, score: float, relation: str) -> dict[str, Any]:
    turned = similarity(1.0, rotation(axis, angle), [0, 0, 0]) @ data.T_object_scene
    return {"T_object_scene": sim3_document(turned), "score": score, "relation": relation}
