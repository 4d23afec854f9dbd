"""What benchmarks.fuzz_contract adds to schemathesis, loaded by it: real files, real ids, and a sharper check.

The service's own state comes from a JSON file that REGNF_FUZZ_WORLD names. Requests meant to break the contract are
sent as they were made; of those that keep to it, most get the files and ids of that state, the others stay invented.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import schemathesis
import yaml
from hypothesis import strategies as st

from benchmarks.fuzz_contract_refusals import CHECKED_STATUSES, beyond_schemas, headers_fit

_WORLD: dict[str, Any] = json.loads(Path(os.environ["REGNF_FUZZ_WORLD"]).read_text(encoding="utf-8"))
_FILES: list[bytes] = [Path(name).read_bytes() for name in _WORLD["files"]]
_FIELD_FILES = st.one_of(st.sampled_from(_FILES), st.binary(min_size=1, max_size=400))
_REAL_OF_FOUR = 3
_MAX_WAIT_S = 1
_LONGER_WAITS = frozenset(str(seconds) for seconds in range(2, 31))
_NOT_THERE_YET = "EnsureResourceAvailability"
_CONTRACT = yaml.safe_load((Path(__file__).resolve().parents[1] / "openapi.yaml").read_text(encoding="utf-8"))

schemathesis.openapi.media_type("application/octet-stream", _FIELD_FILES)
schemathesis.openapi.format("binary", _FIELD_FILES)
_LINE = {
    "scene": _WORLD["fields"]["ready"][0],
    "object": _WORLD["fields"]["ready"][-1],
    "detection": _WORLD["detection"],
}
_LINES = st.one_of(
    st.integers(0, 99).map(lambda seed: json.dumps({**_LINE, "seed": seed}).encode()),
    st.binary(min_size=1, max_size=200).filter(lambda line: bool(line.strip())),
)
schemathesis.openapi.media_type("application/x-ndjson", st.lists(_LINES, min_size=1, max_size=4).map(b"\n".join))


@schemathesis.hook
def filter_failure(context: Any, failure: Any, case: Any, response: Any) -> bool:  # noqa: ARG001
    """All failures but one: an upload's picture is made by its import, later or not at all.

    ``links.preview`` is tried, not promised, so 404 right after the upload is what the contract says.
    """
    return not (type(failure).__name__ == _NOT_THERE_YET and case.path == "/fields/{sha256}/preview.png")


def _keeps_to_the_contract(case: Any) -> bool:
    """Whether every part of the request was meant to: a case of which one part was not is called positive too."""
    meta, label = case.meta, case.operation.label
    if meta is None or not all(part.mode.is_positive for part in (meta.generation, *meta.components.values())):
        return False
    return headers_fit(_CONTRACT, label, case.headers or {})


@schemathesis.check
def refusals_beyond_schemas(ctx: Any, response: Any, case: Any) -> None:  # noqa: ARG001 -- the library's signature
    """A request that fits every schema is refused for a reason that no schema can hold, or not at all."""
    if response.status_code not in CHECKED_STATUSES or not _keeps_to_the_contract(case):
        return
    if case.method == "HEAD" or case.operation.label.startswith("GET /jobs/{id}/"):
        return  # no body, or the job's own problem
    reason = response.json()["reason"]
    if reason not in beyond_schemas(_CONTRACT, case.operation.label):
        raise AssertionError(f"{case.operation.label} refused with {reason} what fits its schemas")


@schemathesis.hook
def before_call(ctx: Any, case: Any, kwargs: Any) -> None:  # noqa: ARG001
    """Put real ids into requests that keep to the contract."""
    if case.query and str(case.query.get("wait")) in _LONGER_WAITS:
        case.query["wait"] = _MAX_WAIT_S
    if not _keeps_to_the_contract(case):
        return
    if case.meta.phase.name.value == "stateful":
        return
    draw = _Draw(case)
    if case.path_parameters:
        _place_ids(case, draw)
    if case.query and "page_token" in case.query and draw.real():
        case.query["page_token"] = draw.one(_WORLD["page_tokens"])
    if case.operation.label in ("POST /register", "POST /render") and isinstance(case.body, dict):
        _place_fields(case.body, draw)


class _Draw:
    """Choices that follow from the request itself, so that a repeated one meets the same."""

    def __init__(self, case: Any) -> None:
        seen = repr((case.operation.label, case.path_parameters, case.query, case.headers, case.body))
        self._state = zlib.crc32(seen.encode("utf-8", "surrogateescape"))

    def below(self, count: int) -> int:
        self._state = zlib.crc32(self._state.to_bytes(4, "big"))
        return self._state % count

    def real(self) -> bool:
        return self.below(4) < _REAL_OF_FOUR

    def one(self, choices: Sequence[Any]) -> Any:
        return choices[self.below(len(choices))]


def _place_ids(case: Any, draw: _Draw) -> None:
    held = "spare" if case.method == "DELETE" else "kept"
    if "sha256" in case.path_parameters and draw.real():
        if case.method == "PUT":
            body = case.body if isinstance(case.body, bytes) else b""
            case.path_parameters["sha256"] = hashlib.sha256(body).hexdigest()
        else:
            case.path_parameters["sha256"] = draw.one(_WORLD["fields"][held])
    if "id" in case.path_parameters and draw.real():
        case.path_parameters["id"] = draw.one(_WORLD["jobs"]["spare" if case.method == "POST" else held])
    if case.operation.label == "GET /jobs/{id}/events" and draw.real():
        case.path_parameters["id"] = draw.one(_WORLD["jobs"]["ended"])  # the stream of an active one does not end
    if "name" in case.path_parameters and draw.real():
        case.path_parameters["name"] = draw.one(_WORLD["artifacts"])


def _place_fields(body: dict[str, Any], draw: _Draw) -> None:
    for member in ("scene", "object"):
        if member in body and draw.real():
            body[member] = draw.one(_WORLD["fields"]["ready"])
    if isinstance(body.get("candidates"), list) and draw.real():
        body["candidates"] = list(_WORLD["fields"]["ready"])
    if "detection" in body and draw.real():
        body["detection"] = _WORLD["detection"]
