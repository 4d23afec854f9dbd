"""openapi.yaml is what the service does: same text, true examples, known reasons, valid answers."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import httpx
import yaml
from jsonschema import Draft202012Validator  # type: ignore[import-untyped]

from regnf_core.errors import VERDICT_REASONS
from regnf_core.options import RobustOptions
from regnf_service.http.routes.examples import OBJECT, OTHER, REGISTER_EXAMPLES, RENDER_EXAMPLES, SCENE
from regnf_state.reasons import REASONS
from regnf_state.records import FieldRecord
from tests.contract.world import World

ROOT = Path(__file__).resolve().parents[2]
CONTRACT: dict[str, Any] = yaml.load((ROOT / "openapi.yaml").read_text(encoding="utf-8"), Loader=yaml.CSafeLoader)


def operations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in CONTRACT["paths"].items():
        for method, operation in methods.items():
            yield method, path, operation


def test_the_committed_contract_is_the_one_that_is_served(world: World) -> None:
    """The generated tables of the pages are the code's too; a changed one would be written anew."""
    committed = (ROOT / "openapi.yaml").read_text(encoding="utf-8")
    assert world.client.get("/openapi.yaml").text == committed, "run scripts/write_openapi.py"
    for name, written, changed in (
        ("write_metric_table", "near 1", "near 2"),
        ("write_option_table", "| 600 |", "| 599 |"),
    ):
        writer = script(name)
        text = writer.TARGET.read_text(encoding="utf-8")
        assert writer.with_table(text) == text, f"run scripts/{name}.py"
        assert writer.with_table(text.replace(written, changed)) == text
    listed = ["up_axis", *(f"robust.{option.name}" for option in fields(RobustOptions))]
    assert [option for option in listed if f"| `{option}` | " not in text] == []


def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_option_says_what_it_is_for_and_every_reference_leads_somewhere() -> None:
    schemas = CONTRACT["components"]["schemas"]
    for group in ("RobustOptions", "RegistrationOptions"):
        for name, option in schemas[group]["properties"].items():
            assert "description" in option or "$ref" in option, name
    text = (ROOT / "openapi.yaml").read_text(encoding="utf-8")
    assert set(re.findall(r"#/components/schemas/(\w+)", text)) <= set(schemas)


def test_every_refusal_is_in_the_table_of_reasons() -> None:
    told = set()
    for method, path, operation in operations():
        for status, answer in operation["responses"].items():
            if "application/problem+json" in answer.get("content", {}):
                reasons = re.findall(r"`([A-Z_]+)`", answer["description"])
                assert reasons, (method, path, status)
                told |= set(reasons)
                assert {REASONS[reason].status for reason in reasons} == {int(status)}, (method, path)
    assert {"FIELD_NOT_FOUND", "JOB_NOT_READY", "INVALID_DETECTION", "UNAUTHENTICATED"} <= told


def test_every_example_is_accepted(world: World) -> None:
    now = world.records.now()
    for sha in (SCENE, OBJECT, OTHER):
        world.records.create_field(FieldRecord(sha, "validating", 600, now, now))
        world.records.update_field(sha, attempt=1, state="ready", report={"bounds": [[-1, -1, -1], [1, 1, 1]]})
    found = 0
    for method, path, operation in operations():
        for kind, content in operation.get("requestBody", {}).get("content", {}).items():
            for name, example in content.get("examples", {}).items():
                answer = world.client.request(method, path, json=example["value"])
                assert (kind, answer.status_code) == ("application/json", 202), (name, answer.text)
                validator({"/register": "RegisterRequest", "/render": "RenderBody"}[path]).validate(example["value"])
                found += 1
    assert found == len(REGISTER_EXAMPLES) + len(RENDER_EXAMPLES)


def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": f"#/components/schemas/{name}", "components": CONTRACT["components"]})


def test_answers_are_valid_by_the_contract(world: World) -> None:
    job_id = world.submit()
    scene = world.valid_request()["scene"]
    for path, schema in [
        ("/", "IndexDocument"), ("/healthz", "HealthDocument"), ("/readyz", "ReadyDocument"),
        ("/version", "VersionDocument"), ("/fields", "FieldPage"), (f"/fields/{scene}", "FieldDocument"),
        ("/jobs", "JobPage"), (f"/jobs/{job_id}", "JobDocument"), (f"/jobs/{job_id}/result", "ProblemDocument"),
        ("/nowhere", "ProblemDocument"),
    ]:  # fmt: skip
        assert_valid(world.client.get(path), schema)
    world.succeed(job_id)
    assert_valid(world.client.get(f"/jobs/{job_id}"), "JobDocument")
    assert_valid(world.client.get(f"/jobs/{job_id}/result"), "ResultDocument")
    assert_valid(world.client.post("/register?dry_run=true", json=world.valid_request()), "DryRunDocument")


def assert_valid(answer: httpx.Response, schema: str) -> None:
    """The answer is a document of this schema, and not one of an empty object, which none of them is."""
    assert answer.is_success == (schema != "ProblemDocument"), answer.text
    assert [fault.message for fault in validator(schema).iter_errors(answer.json())] == []
    assert not validator(schema).is_valid({}), schema


def test_bad_requests_are_bad_by_the_contract_too() -> None:
    good = REGISTER_EXAMPLES["shortest"]["value"]
    contract = validator("RegisterRequest")
    contract.validate(good)
    search = {"scene": SCENE, "detection": good["detection"]}
    changes: list[dict[str, Any]] = [
        {"seed": -1}, {"unknown": 1}, {"scene": "x"}, {"detection": {}}, {"options": {"unknown": 1}},
        {"candidates": [OTHER]}, {"object": None},
    ]  # fmt: skip
    bad = [search, *(good | change for change in changes)]
    bad += [search | {"candidates": names} for names in ([OBJECT, OBJECT], [], None)]
    assert [body for body in bad if contract.is_valid(body)] == []


def test_a_refusal_for_want_of_a_token_is_told_wherever_one_is_asked_for(guarded: World) -> None:
    for method, path, operation in operations():
        told = "401" in operation["responses"]
        address = re.sub(r"\{(\w+)\}", lambda match: "1" if match[1] == "number" else "ab" * 32, path)
        assert (guarded.client.request(method, address).status_code == 401) == told, (method, path)
        assert (operation.get("security") == [{}]) == (not told), (method, path)


def test_times_and_addresses_have_formats_and_closed_sets_are_enums() -> None:
    schemas = CONTRACT["components"]["schemas"]
    for name, schema in schemas.items():
        for member, told in schema.get("properties", {}).items():
            if member.endswith(("_at", "_until")) and member != "look_at":
                kinds = [told, *told.get("anyOf", [])]
                assert "date-time" in [kind.get("format") for kind in kinds], (name, member)
    job = schemas["JobDocument"]["properties"]
    assert job["phase"]["anyOf"][0]["enum"][0] == "loading"
    assert set(job["verdict"]["anyOf"][0]["enum"]) == set(schemas["ResultDocument"]["properties"]["verdict"]["enum"])
    assert schemas["ArtifactEntry"]["properties"]["url"]["format"] == "uri-reference"
    assert [name for name in schemas if "__" in name] == []


def test_the_documents_list_every_reason_and_address() -> None:
    errors = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    assert [reason for reason in REASONS if f"`{reason}`" not in errors] == []
    api, uploads, jobs = (
        (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("api", "uploads", "jobs")
    )
    pages = api + uploads + jobs
    assert [path for _, path, _ in operations() if f"`{path}`" not in pages and f" {path}`" not in pages] == []
    told = re.findall(r"^\| `([A-Z_]+)` \| (?:registered|ambiguous|rejected) \| (.*) \|$", api, flags=re.M)
    assert dict(told) == VERDICT_REASONS
