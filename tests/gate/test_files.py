"""Files that are not what they should be, uploaded: a stable reason, nothing left, and the next good one is taken."""

from __future__ import annotations

import pytest

from tests.core.importing.fuzzing.seeds import Seeds
from tests.gate.bad_containers import CONTAINERS
from tests.gate.bad_pickles import CANARY, PICKLES
from tests.gate.bad_runs import RUNS
from tests.gate.bad_tensors import TENSORS
from tests.gate.house import House


@pytest.mark.parametrize("row", CONTAINERS)
def test_container(house: House, seeds: Seeds, row: str) -> None:
    build, outcome = CONTAINERS[row]
    assert house.outcome(build(seeds)) == outcome


@pytest.mark.parametrize("row", PICKLES)
def test_pickle(house: House, seeds: Seeds, row: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the pickle names, nothing is run: no canary appears."""
    monkeypatch.chdir(house.scratch)
    build, outcome = PICKLES[row]
    assert house.outcome(build(seeds)) == outcome
    assert not CANARY.exists()
    forget(house)


@pytest.mark.parametrize("row", TENSORS)
def test_tensors(house: House, seeds: Seeds, row: str) -> None:
    build, outcome = TENSORS[row]
    assert house.outcome(build(seeds)) == outcome
    forget(house)


@pytest.mark.parametrize("row", RUNS)
def test_run(house: House, seeds: Seeds, row: str) -> None:
    build, outcome = RUNS[row]
    assert house.outcome(build(seeds)) == outcome


def forget(house: House) -> None:
    """Delete the field if it was taken, so that what is left is what should not be."""
    for field in house.world.client.get("/fields").json()["fields"]:
        if field["state"] == "ready":
            assert house.world.client.delete(field["links"]["self"]).status_code == 204
