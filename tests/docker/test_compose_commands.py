"""Every compose command that the documentation prints renders, and starts services that have what they need."""

from __future__ import annotations

import os
import subprocess

import pytest

from regnf_cli.embedded_redis import StartError, check_access
from regnf_state.settings import Settings
from scripts.images.commands import ComposeCommand, documented_commands
from scripts.images.compose import Service, render
from tests.docker.files import COMPOSE, ROOT

COMMANDS = documented_commands(ROOT)
every_command = pytest.mark.parametrize("command", COMMANDS, ids=lambda command: f"{command.source}: {command.text}")


def settings_of(service: Service, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """What the program in the container reads: its environment, and nothing of this process'."""
    for name in [name for name in os.environ if name.startswith("REGNF_")]:
        monkeypatch.delenv(name)
    for name, value in service["environment"].items():
        monkeypatch.setenv(name, value.replace("@/run/redis/password", "password"))  # the file is in a volume
    return Settings()


def test_the_documentation_prints_commands_and_the_front_end_knows_its_port() -> None:
    sources = {command.source for command in COMMANDS}
    assert sources == {"README.md", "docs/deployment.md", "docker/compose.yaml"}
    assert {profile for command in COMMANDS for profile in command.profiles} == {"cpu", "gpu", "observability"}
    for variables in ({}, {"REGNF_PUBLISH": "127.0.0.1:9000"}):
        services = render(COMPOSE, variables)
        assert services["proxy"]["ports"] == [f"{services['api']['environment']['REGNF_PUBLISH']}:8000"]


@every_command
def test_what_a_command_starts_has_what_it_needs(command: ComposeCommand, monkeypatch: pytest.MonkeyPatch) -> None:
    services = render(ROOT / command.file, command.variables, command.profiles)
    workers = [name for name in services if name.startswith("worker")]
    assert workers
    assert set(command.scale) <= set(services)
    for name in ("api", *workers):
        settings = settings_of(services[name], monkeypatch)
        assert settings.redis_url == "redis://redis:6379/0"
        if name == "api":
            check_access(settings)
        else:
            assert not settings.api_tokens
    assert ("grafana" in services) == ("observability" in command.profiles)
    if "grafana" in services:
        assert services["grafana"]["environment"]["GF_SECURITY_ADMIN_PASSWORD"]


def test_published_to_others_it_does_not_start_without_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    services = render(COMPOSE, {"REGNF_PUBLISH": "0.0.0.0:8080"}, ["cpu"])
    assert services["proxy"]["ports"] == ["0.0.0.0:8080:8000"]
    with pytest.raises(StartError) as caught:
        check_access(settings_of(services["api"], monkeypatch))
    assert caught.value.reason == "UNAUTHENTICATED_PUBLIC_BIND"


@pytest.mark.parametrize(("password", "status"), [("", 1), ("a-password", 0)])
def test_grafana_does_not_start_without_a_password(password: str, status: int) -> None:
    grafana = render(COMPOSE, {"GRAFANA_PASSWORD": password}, ["observability"])["grafana"]
    shell, option, script = grafana["entrypoint"]
    assert script.endswith("; exec /run.sh")
    done = subprocess.run(
        [shell, option, script.removesuffix("/run.sh") + "true"],
        env={"PATH": os.environ["PATH"]} | grafana["environment"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (status, "" if password else "set GRAFANA_PASSWORD\n")
