"""A registration request goes into a record and comes back as it was, to the last bit."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from regnf_core.detections import Detection
from regnf_core.errors import InvalidOptionsError
from regnf_core.options import RegistrationOptions
from regnf_state.registration_request import RegistrationRequest, UnknownRequestVersionError
from tests.requests import registration_request

ROWS = [[0.1, 0.0, 0.0, 1 / 3], [0.0, 0.1, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 1.0]]
BOX = Detection((0.1, 0.2, 0.3), (1.0, 2.0, 1 / 3), (0.18257418583505536, 0.3651483716701107, 0.5, 0.7), "chair", 0.9)
FULL = RegistrationRequest(
    "a" * 64, "b" * 64, None, BOX, RegistrationOptions(preset="paper"), 7, ROWS, ROWS, "https://example.org/hook"
)
SEARCH = registration_request("a" * 64, None, candidates=("b" * 64, "c" * 64), options=RegistrationOptions())


@pytest.mark.parametrize("request_", [FULL, SEARCH, registration_request("a", "b")])
def test_a_request_survives_its_record(request_: RegistrationRequest) -> None:
    assert RegistrationRequest.from_record(json.loads(json.dumps(request_.to_record()))) == request_


def test_the_objects_are_one_or_all_candidates() -> None:
    assert FULL.objects == ("b" * 64,)
    assert SEARCH.objects == ("b" * 64, "c" * 64)


def test_a_caller_has_fields_of_its_own() -> None:
    owned = SEARCH.owned_by("alice")
    assert (owned.scene, owned.object) == ("a" * 64 + "_alice", None)
    assert owned.candidates == ("b" * 64 + "_alice", "c" * 64 + "_alice")
    assert FULL.owned_by("anonymous") == FULL


@pytest.mark.parametrize("version", [None, 0, 2, "1"])
def test_a_record_of_another_version_is_refused(version: object) -> None:
    with pytest.raises(UnknownRequestVersionError, match=str(version)):
        RegistrationRequest.from_record(FULL.to_record() | {"version": version})


def test_options_that_are_gone_are_refused_by_name() -> None:
    record = FULL.to_record() | {"options": {"no_such_option": 1}}
    with pytest.raises(InvalidOptionsError, match="no_such_option"):
        RegistrationRequest.from_record(record)


def test_a_plain_request_names_no_webhook() -> None:
    assert "webhook" not in replace(FULL, webhook=None).values()
    assert FULL.values()["webhook"] == {"url": "https://example.org/hook"}
