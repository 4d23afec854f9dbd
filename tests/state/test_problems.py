"""One problem object for a reason, whoever makes it; one table of artifacts."""

from __future__ import annotations

import pytest

from regnf_core.errors import InvalidInputError
from regnf_service.http.schemas.results import whole_problem
from regnf_service.problem import Problem
from regnf_state.manifest import ARTIFACTS, Artifact
from regnf_state.reasons import REASONS, problem_document
from regnf_worker.job_limits import fault


@pytest.mark.parametrize("reason", sorted(REASONS))
def test_an_answer_and_a_record_hold_the_same_problem(reason: str) -> None:
    kept = problem_document(reason)
    assert Problem(reason).document() == kept
    assert whole_problem({"reason": reason}) == kept
    assert (kept["status"], kept["title"], kept["detail"]) == (
        REASONS[reason].status,
        REASONS[reason].title,
        REASONS[reason].meaning,
    )


def test_a_worker_makes_the_same_problem() -> None:
    assert fault(MemoryError(), "0123") == problem_document("OUT_OF_MEMORY")


def test_a_hint_that_says_more_goes_first() -> None:
    error = InvalidInputError("bad", reason="NO_SURFACE_IN_DETECTION")
    usual = problem_document(error.reason)["hint"]
    assert usual
    assert problem_document(error.reason, hint="the box is in millimeters")["hint"] == "the box is in millimeters"


def test_every_artifact_has_one_media_type() -> None:
    for name, kind in ARTIFACTS.items():
        assert Artifact(name, 1, "0").media_type == kind
    assert ARTIFACTS["residuals.npz"] == "application/octet-stream"
