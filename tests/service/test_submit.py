"""From a checked request to a job: what it costs."""

from __future__ import annotations

from pathlib import Path

import pytest
from redis import Redis

from regnf_service.jobs.submit import check_fields
from regnf_state.ownership import ANONYMOUS
from regnf_state.records import FieldRecord
from regnf_state.settings import Settings
from tests.requests import registration_request
from tests.round_trips import counted_round_trips
from tests.stores import services_over


@pytest.mark.parametrize("count", [1, 512])
def test_any_number_of_candidates_is_one_round_trip(
    redis: Redis, tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = services_over(redis, Settings(state_dir=tmp_path))
    names = [f"{number:064x}" for number in range(count + 1)]
    for name in names:
        services.records.restore_field(FieldRecord(name, "ready", 1, 1.0, 1.0))
    scene, *candidates = names
    sent = counted_round_trips(monkeypatch)
    named = {"/scene": scene} | {f"/candidates/{place}": name for place, name in enumerate(candidates)}
    check_fields(services, ANONYMOUS, registration_request(scene, None, candidates=tuple(candidates)), named)
    assert sent == ["pipeline"]
