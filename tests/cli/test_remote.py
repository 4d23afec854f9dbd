"""`regnf register --server`: what is said of services that are absent, unable, or no regnf service at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from regnf_client.answers import NoWorkerError
from regnf_client.steps import WorkerWatch
from tests.cli.conftest import JOB, Answer, Run, Serve, service, without_worker


@pytest.mark.parametrize(("verdict", "code"), [("registered", 0), ("ambiguous", 4), ("rejected", 1)])
def test_the_verdict_decides(verdict: str, code: int, run: Run, demo: list[object], serve: Serve) -> None:
    outcome = run(*demo, "--server", serve(service(verdict=verdict)), code=code)
    assert outcome.stdout.startswith(f"verdict      {verdict}  (BECAUSE)")


def test_fields_that_the_service_has_without_a_name_get_one(run: Run, demo: list[object], serve: Serve) -> None:
    asked: list[str] = []

    def answers(method: str, path: str) -> Answer:
        if path.startswith("/fields/"):
            asked.append(method)
        return service()(method, path)

    run(*demo, "--server", serve(answers), code=0)
    assert asked.count("PATCH") == 2


@pytest.mark.parametrize("checks", [{"worker": True, "storage": False}, {}, [], "?"])
def test_a_worker_is_missing_only_where_the_service_says_so(
    checks: object, run: Run, demo: list[object], serve: Serve
) -> None:
    looks: list[str] = []
    stuck = without_worker("jobs", checks)

    def answers(method: str, path: str) -> Answer:
        looks.append(path)
        return stuck(method, path) if looks.count("/jobs/j") < 4 else service()(method, path)

    run(*demo, "--server", serve(answers), "--worker-timeout", 0, code=0)
    assert looks.count("/readyz") == 1


def test_the_watch_counts_only_an_absence_without_a_break() -> None:
    now, looks = [100.0], []
    watch = WorkerWatch(60.0, clock=lambda: now[0])
    there, absent = [(100.0, True), (104.9, True)], [(105.0, False), (164.0, False), (169.0, True), (174.0, False)]
    for seconds, lives in [*there, *absent, (230.0, False), (233.9, False)]:
        now[0] = seconds
        if watch.due:
            looks.append(seconds)
            watch.saw(lives)
    assert looks[:2] == [100.0, 105.0], "not more often than every five seconds"
    now[0] = 234.0
    assert watch.due
    with pytest.raises(NoWorkerError, match="60 s"):
        watch.saw(False)


def test_artifacts_stay_in_the_folder(run: Run, demo: list[object], serve: Serve, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    address = serve(service(artifacts=[{"name": "../outside.txt", "bytes": 1, "sha256": None, "url": "/jobs/j"}]))
    run(*demo, "--output", folder, "--server", address, code=0)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["outside.txt"]
    assert (folder / "outside.txt").read_text() == "content"


def test_a_failed_job_tells_its_own_reason(run: Run, demo: list[object], serve: Serve) -> None:
    own = {"reason": "NO_SURFACE_IN_DETECTION", "status": 422, "detail": "12 surface points were found"}
    whole = service()

    def answers(method: str, path: str) -> Answer:
        if path == "/jobs/j":
            return 200, json.dumps(JOB | {"status": "failed", "error": own})
        if path == "/jobs/j/result":
            return 409, json.dumps({"reason": "JOB_FAILED", "detail": "The job failed.", "error": own})
        return whole(method, path)

    outcome = run(*demo, "--server", serve(answers), code=2)
    assert "NO_SURFACE_IN_DETECTION 12 surface points were found" in outcome.stderr
