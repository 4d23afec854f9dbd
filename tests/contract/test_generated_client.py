"""A client that a generator makes from openapi.yaml: complete, typed, and right about the running service."""

from __future__ import annotations

import importlib
import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.contract.live import Live
from tests.contract.world import NOBODY, World, field_bytes, sha256

ROOT = Path(__file__).resolve().parents[2]
NAME = "regnf_generated_client"
SETTINGS = """\
content_type_overrides:
  image/png: application/octet-stream
  model/gltf-binary: application/octet-stream
  application/yaml: application/octet-stream
  application/x-ndjson: application/octet-stream
post_hooks: []
"""


class Generated:
    """The generated package's modules, by their names."""

    def module(self, name: str) -> ModuleType:
        return importlib.import_module(f"{NAME}.{name}")

    def operation(self, tag: str, name: str) -> Any:
        return self.module(f"api.{tag}.{name}")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Generated]:
    folder = tmp_path_factory.mktemp("generated")
    (folder / "config.yml").write_text(SETTINGS)
    command = ["-m", "openapi_python_client", "generate", "--path", str(ROOT / "openapi.yaml"), "--meta", "none"]
    places = ["--config", str(folder / "config.yml"), "--output-path", str(folder / NAME), "--fail-on-warning"]
    done = subprocess.run(
        [sys.executable, *command, *places], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout
    sys.path.insert(0, str(folder))
    yield Generated()
    sys.path.remove(str(folder))
    for name in [name for name in sys.modules if name.partition(".")[0] == NAME]:
        del sys.modules[name]


def test_every_operation_has_a_function(generated: Generated, world: World) -> None:
    for operations in world.app.openapi()["paths"].values():
        for operation in operations.values():
            (tag,) = operation["tags"]
            assert callable(generated.operation(tag, operation["operationId"]).sync_detailed)


@pytest.mark.usefixtures("nothing_stays_live")
def test_a_field_goes_there_and_back(generated: Generated, live: Live) -> None:
    models, types = generated.module("models"), generated.module("types")
    content = field_bytes("of the generated client")
    name = sha256(content)
    with generated.module("client").Client(base_url=live.address) as client:
        made = generated.operation("fields", "put_field").sync(
            name, client=client, body=types.File(payload=io.BytesIO(content))
        )
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
