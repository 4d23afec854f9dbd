"""openapi.yaml: the contract, made from the routes and the schemas, and committed at the top of the repository."""

from __future__ import annotations

import json
from typing import Any, Literal

import yaml
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import TypeAdapter

from regnf_core import __version__
from regnf_service.http.problems import MEDIA_TYPE, OPEN_PATHS
from regnf_service.http.schemas.reading import REFERENCED
from regnf_state.reasons import REASONS

_DESCRIPTION = """\
Register neural signed distance fields: given the field of a scene, a detection box in it and the field of a library
object, find the object's pose and scale in the scene (a similarity transform).

Upload both fields, post a detection to `/register`, wait for the job and get its result. Every error is a problem
object (RFC 9457) with a stable `reason`. Programs should branch on `reason`, never on the text. Responses may gain
members in later releases.

If the service has access tokens, every call needs `Authorization: Bearer`, except `/healthz`, `/static`, `/docs` and
the page of a job. A call without a valid token gets 401 `UNAUTHENTICATED`. Each token belongs to a caller. The fields
and jobs of other callers give 404. If the service limits the rate of calls, any address that needs a token may return
429 `RATE_LIMITED` with `Retry-After`. A caller with too many requests in progress gets 429
`TOO_MANY_REQUESTS_AT_ONCE`.

An unknown query parameter at an address of fields, registrations or jobs gives 400 `INVALID_QUERY`.
"""
_TAGS = {
    "fields": "Upload fields and read the report of their import.",
    "recordings": "Upload frames of a depth camera and view them.",
    "library": "Objects by name and tag. A search compares a detection with them.",
    "registrations": "Find the pose of an object in a scene.",
    "batches": "Many registrations in one request.",
    "renderings": "Pictures, meshes and fields of edited scenes.",
    "jobs": "Follow, cancel and delete jobs.",
    "results": "The result of a job, its files and its page.",
    "service": "State, version and contract of the service.",
}
_UNUSED = ("HTTPValidationError", "ValidationError")


def build_contract(app: FastAPI) -> dict[str, Any]:
    """The contract of an app's routes, OpenAPI 3.1."""
    contract = get_openapi(
        title="regnf API",
        version=__version__,
        description=_DESCRIPTION,
        routes=app.routes,
        servers=[{"url": "/"}, {"url": "/v1"}],
        license_info={"name": "MIT", "identifier": "MIT"},
    )
    components = contract.setdefault("components", {})
    inputs: list[tuple[Any, Literal["validation"], TypeAdapter[Any]]] = [
        (name, "validation", TypeAdapter(model)) for name, model in REFERENCED.items()
    ]
    _, extra = TypeAdapter.json_schemas(inputs, ref_template="#/components/schemas/{model}")
    components["schemas"] = dict(sorted((extra["$defs"] | components.get("schemas", {})).items()))
    for name in _UNUSED:
        components["schemas"].pop(name, None)
    components["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    contract["security"] = [{}, {"token": []}]
    contract["tags"] = [{"name": name, "description": told} for name, told in _TAGS.items()]
    contract["x-reasons"] = {name: {"status": one.status, "meaning": one.meaning} for name, one in REASONS.items()}
    for path, operations in contract["paths"].items():
        for method, operation in operations.items():
            _mend(operation)
            _say_who_may_call(path, operation)
            if method == "head":
                _drop_content(operation)
    return contract


def _mend(operation: dict[str, Any]) -> None:
    """Drop the framework's own 422, which this service never sends, and what it says twice; statuses in order."""
    for parameter in operation.get("parameters", []):
        for repeated in ("title", "description"):
            parameter["schema"].pop(repeated, None)
        _drop_null(parameter["schema"])
    responses = operation["responses"]
    schema = responses.get("422", {}).get("content", {}).get("application/json", {}).get("schema", {})
    if schema.get("$ref", "").endswith("/HTTPValidationError"):
        del responses["422"]
    operation["responses"] = dict(sorted(responses.items()))


def _say_who_may_call(path: str, operation: dict[str, Any]) -> None:
    """401 wherever a token is requested where some are configured; the other addresses need none."""
    if OPEN_PATHS.fullmatch(path.replace("{id}", "id")):
        operation["security"] = [{}]
        return
    problem = {"$ref": "#/components/schemas/ProblemDocument"}
    refusal = {"description": "`UNAUTHENTICATED`", "content": {MEDIA_TYPE: {"schema": problem}}}
    operation["responses"] = dict(sorted((operation["responses"] | {"401": refusal}).items()))


def _drop_null(schema: dict[str, Any]) -> None:
    """Nobody can send null in a query or a header: what is not required is left out."""
    match [kind for kind in schema.get("anyOf", []) if kind != {"type": "null"}]:
        case [only]:
            del schema["anyOf"]
            schema |= only


def _drop_content(operation: dict[str, Any]) -> None:
    for response in operation["responses"].values():
        response.pop("content", None)


class _Dumper(yaml.SafeDumper):
    """Texts of several lines as blocks, as people write them; no references between equal parts."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 -- the base class's signature
        return True


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None),
)


def contract_yaml(app: FastAPI) -> str:
    """The contract as the file holds it."""
    text: str = yaml.dump(app.openapi(), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    return text


def contract_json(app: FastAPI) -> str:
    """The same as JSON."""
    return json.dumps(app.openapi(), ensure_ascii=False)
