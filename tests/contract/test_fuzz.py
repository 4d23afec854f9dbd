"""Property-based tests of the contract against the real service, the reduced form of benchmarks.fuzz_contract."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import fuzz_contract
from tests.contract.live import live_service

REDUCED = ["--phases", "examples,fuzzing,stateful", "--max-examples", "4", "--seed", "1", "--no-shrink"]


@pytest.mark.long
def test_no_request_is_answered_against_the_contract(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    with live_service(tmp_path / "state", **fuzz_contract.SETTINGS, preload=True) as live:
        outcome = fuzz_contract.run(live, tmp_path, REDUCED, spare_fields=1)
    assert not outcome.failures, "\n\n".join(outcome.failures)
    assert outcome.requests >= 100
    assert outcome.phases["fuzzing"] == outcome.phases["stateful"] == "success"
    assert min(outcome.covered[f"POST /{what}"] for what in ("register", "jobs/{id}/cancel")) > 0
