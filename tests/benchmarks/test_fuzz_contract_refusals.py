"""What the property-based tests let pass agrees with the contract and with their own configuration."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.fuzz_contract_refusals import (
    CHECKED_STATUSES,
    OF_MEMBERS,
    OF_STATE,
    beyond_schemas,
    documented,
    headers_fit,
)
from regnf_state.reasons import REASONS

_ROOT = Path(__file__).resolve().parents[2]
_CONTRACT: dict[str, Any] = yaml.safe_load((_ROOT / "openapi.yaml").read_text(encoding="utf-8"))
_TOLD: list[dict[str, Any]] = tomllib.loads((_ROOT / "benchmarks" / "fuzz_contract.toml").read_text())["operations"]
_METHODS = frozenset({"get", "head", "put", "post", "patch", "delete"})
_OPERATIONS = [f"{m.upper()} {path}" for path, item in _CONTRACT["paths"].items() for m in item if m in _METHODS]
_PASS_ANYWHERE = frozenset({401, 403, 404, 409, 429})
"""Statuses that schemathesis's ``positive_data_acceptance`` lets pass where its configuration says nothing."""


@pytest.mark.parametrize("operation", _OPERATIONS)
def test_every_refusal_that_may_be_met_has_a_status_that_passes(operation: str) -> None:
    statuses = {REASONS[reason].status for reason in beyond_schemas(_CONTRACT, operation)}
    told = [entry["checks"] for entry in _TOLD if _means(entry, operation)]
    assert len(told) <= 1, "two entries of the configuration mean the same operation"
    passing = _PASS_ANYWHERE
    if told:
        passing = frozenset(int(s) for s in told[0]["positive_data_acceptance"]["expected-statuses"] if s.isdigit())
    assert statuses <= passing


def _means(entry: dict[str, Any], operation: str) -> bool:
    if "include-name" in entry:
        return bool(entry["include-name"] == operation)
    return re.search(entry["include-name-regex"], operation) is not None


def test_reasons_of_members_are_documented_for_their_operations() -> None:
    assert set(OF_MEMBERS) <= set(_OPERATIONS)
    for operation, reasons in OF_MEMBERS.items():
        assert reasons <= documented(_CONTRACT, operation), operation


def test_every_reason_has_a_status_at_which_reasons_are_looked_at() -> None:
    for reason in OF_STATE.union(*OF_MEMBERS.values()):
        assert REASONS[reason].status in CHECKED_STATUSES, reason


def test_a_rejected_field_may_be_met_wherever_a_field_is_named_and_a_malformed_body_nowhere() -> None:
    naming = {operation for operation in _OPERATIONS if "FIELD_REJECTED" in beyond_schemas(_CONTRACT, operation)}
    assert naming == {"POST /library", "POST /recordings/{sha256}/frames", "POST /register", "POST /render"}
    assert not any("MALFORMED_JSON" in beyond_schemas(_CONTRACT, operation) for operation in _OPERATIONS)


@pytest.mark.parametrize(
    ("headers", "fit"),
    [
        ({}, True),
        ({"Content-Range": "bytes 0-3/8", "Content-Digest": f"sha-256=:{'A' * 43}=:"}, True),
        ({"content-range": "bytes */8", "x-other": ""}, True),
        ({"Content-Range": ""}, False),
        ({"content-digest": "", "Content-Range": "bytes */8"}, False),
    ],
)
def test_headers_fit_where_each_has_its_pattern(headers: dict[str, str], fit: bool) -> None:
    assert headers_fit(_CONTRACT, "PUT /fields/{sha256}", headers) is fit
