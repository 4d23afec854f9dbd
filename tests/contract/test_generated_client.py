"""A client that a generator makes from openapi.yaml: complete, typed, and right about the running service."""

from __future__ import annotations

import importlib
import inspect
import io
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

import pytest

from tests.contract.live import Live
from tests.contract.world import NOBODY, World, field_bytes, sha256
from tests.live_stack import LIVE

pytestmark = LIVE
ROOT = Path(__file__).resolve().parents[2]
NAME = "regnf_api_client"
"""The generator takes it from the title of the contract. regnf's own client is another package, regnf_client."""
LOW, HIGH = [-0.83615, -0.58285, -0.499], [-0.2894, 0.01535, 0.01244999999999996]
"""Exactly the box of the demo's detection.json: one request is one job with that of test_live_jobs."""
PAGE = (ROOT / "docs" / "client.md").read_text()


def block(language: str) -> str:
    """The last block in this language on the page, which is about generated clients."""
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[-1]


class Generated:
    def module(self, name: str) -> ModuleType:
        return importlib.import_module(f"{NAME}.{name}")

    def operation(self, tag: str, name: str) -> Any:
        return self.module(f"api.{tag}.{name}")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Generated]:
    folder = tmp_path_factory.mktemp("generated")
    (folder / "generator.yml").write_text(block("yaml") + "post_hooks: []\n")
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", str(ROOT / "openapi.yaml")]
    command += ["--config", str(folder / "generator.yml"), "--fail-on-warning"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout
    (made,) = folder.glob("*/")
    sys.path.insert(0, str(made))
    yield Generated()
    sys.path.remove(str(made))
    for name in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[name]


def test_every_operation_has_a_function_and_every_body_a_type(generated: Generated, world: World) -> None:
    """None is Any: what a generator makes of a schema that it does not understand, and then takes nothing for."""
    bodies = 0
    for operations in world.app.openapi()["paths"].values():
        for operation in operations.values():
            (tag,) = operation["tags"]
            function = generated.operation(tag, operation["operationId"]).sync_detailed
            if "body" in inspect.signature(function).parameters:
                hint = get_type_hints(function)["body"]
                kinds = set(get_args(hint) or [hint])
                assert Any not in kinds, operation["operationId"]
                assert all(isinstance(kind, type) for kind in kinds), operation["operationId"]
                bodies += 1
    assert bodies >= 8
    with pytest.raises(TypeError):
        generated.module("models").RegisterRequest()


def test_a_registration_from_the_files_to_the_result(
    generated: Generated, live_stack: Live, demo_fields: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    models = generated.module("models")
    with generated.module("client").Client(base_url=live_stack.address, timeout=60) as client:
        program = block("python").replace("http://127.0.0.1:8080", live_stack.address)
        for words, corner in (("[-0.4, -0.3, 0.0]", LOW), ("[0.1, 0.2, 0.4]", HIGH)):
            assert words in program
            program = program.replace(words, str(corner))
        names: dict[str, Any] = {"scene": demo_fields["scene"], "chair": demo_fields["object"]}
        exec(program, names)
        assert capsys.readouterr().out.strip() == str(models.ResultDocumentVerdict.REGISTERED)
        result = generated.operation("results", "get_result").sync(names["job"].id, client=client)
        assert isinstance(result, models.ResultDocument)
        assert [len(row) for row in result.t_object_scene.matrix] == [4] * 4
        wrong = models.RegisterRequest(scene=names["scene"], detection=names["box"])
        refused = generated.operation("registrations", "register").sync(client=client, body=wrong)
        assert isinstance(refused, models.ProblemDocument)
        assert refused.reason == "INVALID_REQUEST"


def test_a_field_goes_there_and_back(generated: Generated, world: World) -> None:
    models, types = generated.module("models"), generated.module("types")
    content = field_bytes("of the generated client")
    name = sha256(content)
    client = generated.module("client").Client(base_url="http://localhost").set_httpx_client(world.client)
    body = types.File(payload=io.BytesIO(content))
    made = generated.operation("fields", "put_field").sync(name, client=client, body=body)
    assert isinstance(made, models.FieldDocument)
    assert made.state == models.FieldDocumentState.VALIDATING
    assert made.created_at.tzinfo is not None
    listed = generated.operation("fields", "list_fields").sync(client=client)
    assert [field.sha256 for field in listed.fields] == [name]
    refused = generated.operation("jobs", "get_job").sync(NOBODY, client=client)
    assert isinstance(refused, models.ProblemDocument)
    assert (refused.status, refused.reason) == (404, "JOB_NOT_FOUND")


def test_a_token_is_asked_for_and_taken(generated: Generated, guarded: World) -> None:
    models, clients = generated.module("models"), generated.module("client")
    jobs = generated.operation("jobs", "list_jobs")
    without = clients.Client(base_url="http://localhost").set_httpx_client(guarded.client)
    answer = jobs.sync(client=without)
    assert isinstance(answer, models.ProblemDocument)
    assert answer.reason == "UNAUTHENTICATED"
    guarded.client.headers["Authorization"] = "Bearer first-token"
    assert isinstance(jobs.sync(client=without), models.JobPage)
