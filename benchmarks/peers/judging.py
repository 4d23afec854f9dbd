"""What one run of one method is worth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.peers.interface import MissingPackageError, Peer, PeerCase, PeerResult
from benchmarks.symmetric_errors import errors_against_truth
from regnf_core import RegnfError
from regnf_core.geometry.metrics import paper_errors
from regnf_core.version import ENGINE_REVISION

SUCCESS = 0.05
"""Largest MSSD of a right pose, object diameters."""
RIGHT, WRONG, NO_POSE, SKIPPED = "right", "WRONG POSE", "no pose", "skipped"
DEFINITION = (
    "Success: MSSD (least over the object's declared symmetries) at most 5 % of the object's diameter. "
    "A method that says itself that it found nothing has no pose, which is no success, and no wrong pose either."
)
_POINTS = 2000
_ERRORS = (
    "translation_rmse",
    "euler_rmse_rad",
    "scale_error",
    "rotation_error_rad",
    "translation_error_share",
    "scale_error_share",
    "add_s_share",
)


def judge(result: PeerResult, case: PeerCase) -> dict[str, Any]:
    """Category and errors; every method's over the same points of the object."""
    if result.T_object_scene is None:
        return {"verdict": "none", "reason": result.note, "category": NO_POSE}
    points = case.object_samples.points
    points = points[:: max(1, len(points) // _POINTS)]
    errors = errors_against_truth(result.T_object_scene, case.truth, points, case.symmetries)
    errors |= paper_errors(result.T_object_scene, case.truth)
    apart = float((result.T_object_scene.translation - case.truth.translation).norm())
    errors["translation_error_share"] = apart / case.diameter
    share = errors["mssd"] / case.diameter
    return {
        "verdict": "pose",
        "reason": result.note,
        "category": RIGHT if share <= SUCCESS else WRONG,
        "mssd_share": share,
        **{name: errors[name] for name in _ERRORS},
    }


def run_one(name: str, make: Callable[[], Peer], case: PeerCase, seed: int) -> dict[str, Any]:
    """One method on one case: a plain dictionary, whether it finds a pose, gives up, or is not installed.

    seconds and field_evaluations include the shared sampling where the method starts from its points.
    """
    found: dict[str, Any] = {"revision": ENGINE_REVISION, "group": name, "case": case.name, "seed": seed}
    try:
        peer = make()
        found |= {"group": peer.name, "given": peer.given}
        result = peer.register(case, seed)
    except MissingPackageError as error:
        return found | {"verdict": "none", "reason": str(error), "category": SKIPPED}
    except RegnfError as error:
        return found | {"verdict": "none", "reason": error.reason or type(error).__name__, "category": NO_POSE}
    seconds, evaluations = result.seconds, result.field_evaluations
    if peer.uses_samples:
        seconds, evaluations = seconds + case.sampling_seconds, evaluations + case.sampling_evaluations
    return found | {"seconds": seconds, "field_evaluations": evaluations, **judge(result, case)}


def no_points(name: str, case: str, error: RegnfError) -> dict[str, Any]:
    """A run that no method could begin: the shared sampling found no surface."""
    reason = error.reason or type(error).__name__
    return {"group": name, "case": case, "seed": 0, "verdict": "none", "reason": reason, "category": NO_POSE}
