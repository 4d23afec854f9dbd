"""The compose file: valid, hardened, and saying what the documentation says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from regnf_state.settings import Settings
from tests.docker.files import COMPOSE, DOCKERFILES, ROOT, compose, services

# Read by the compose file itself, not by the program.
COMPOSE_ONLY = {"REGNF_PUBLISH", "REGNF_TLS_DIR"}


def test_follows_the_compose_specification() -> None:
    checker = Path(sys.executable).with_name("check-jsonschema")
    command = [str(checker), "--builtin-schema", "vendor.compose-spec", str(COMPOSE)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def test_holds_exactly_these_services() -> None:
    profiles = {name: service.get("profiles") for name, service in services().items()}
    assert profiles == {
        "redis": None,
        "api": None,
        "proxy": None,
        "worker": ["cpu"],
        "worker-gpu": ["gpu"],
        "prometheus": ["observability"],
        "grafana": ["observability"],
    }


def test_what_the_programs_are_given() -> None:
    reserved = services()["worker-gpu"]["deploy"]["resources"]["reservations"]["devices"]
    assert reserved == [{"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}]
    assert services()["worker-gpu"]["environment"]["REGNF_DEVICE"] == "cuda"
    assert "reservations" not in services()["worker"]["deploy"]["resources"]
    memory = services()["worker"]["deploy"]["resources"]["limits"]["memory"]
    assert int(memory.removesuffix("G")) * 2**30 > Settings.model_fields["import_memory_bytes"].default
    texts = [path.read_text() for path in (COMPOSE, *DOCKERFILES)]
    named = set(re.findall(r"REGNF_[A-Z_]*[A-Z]", "\n".join(texts)))
    assert named - COMPOSE_ONLY <= {f"REGNF_{name.upper()}" for name in Settings.model_fields}
    document = compose()
    used = {entry.split(":")[0] for service in services().values() for entry in service["volumes"]}
    used = {name for name in used if not name.startswith((".", "$"))}
    assert used == set(document["volumes"])
    assert {network for service in services().values() for network in service["networks"]} == set(document["networks"])


def test_what_watches_finds_what_it_watches() -> None:
    config = yaml.safe_load((ROOT / "deploy/prometheus/prometheus.yaml").read_text())
    (job,) = config["scrape_configs"]
    port = services()["api"]["environment"]["REGNF_METRICS_ADDRESS"].rpartition(":")[2]
    assert (job["job_name"], job["dns_sd_configs"]) == ("regnf", [{"names": ["api"], "type": "A", "port": int(port)}])
    for rules in config["rule_files"]:
        assert (ROOT / "deploy/prometheus" / Path(rules).name).is_file()
    folder = ROOT / "deploy/grafana/provisioning"
    (source,) = yaml.safe_load((folder / "datasources/prometheus.yaml").read_text())["datasources"]
    assert source["url"] == "http://prometheus:9090"
    (boards,) = yaml.safe_load((folder / "dashboards/regnf.yaml").read_text())["providers"]
    mounted = [volume.split(":")[1] for volume in services()["grafana"]["volumes"]]
    assert f"{boards['options']['path']}/regnf.json" in mounted
    for name in ("prometheus", "grafana"):
        for volume in services()[name]["volumes"]:
            source_path = volume.split(":")[0]
            assert not source_path.startswith("..") or (ROOT / "docker" / source_path).exists()


def test_every_service_is_hardened() -> None:
    for name, service in services().items():
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["read_only"] is True, name
        assert any(entry.startswith("/tmp") for entry in service["tmpfs"]), name
        assert service["restart"] == "unless-stopped", name
        assert service["healthcheck"]["test"], name
        assert {"memory", "pids"} <= set(service["deploy"]["resources"]["limits"]), name
        assert not {"privileged", "cap_add"} & set(service), name


def test_redis_forgets_nothing() -> None:
    redis = services()["redis"]
    command = " ".join(redis["command"])
    for said in ("--appendonly yes", "--appendfsync everysec", "--maxmemory-policy noeviction"):
        assert said in command
    assert redis["volumes"] == ["redis:/data", "./redis.sh:/etc/redis.sh:ro"]
    assert "ports" not in redis
    assert redis["user"].split(":")[0] not in ("0", "root")
    memory = re.search(r"--maxmemory (\d+)mb", command)
    assert memory is not None
    # rewriting the append-only file may need the memory once more
    assert int(memory[1]) * 2 <= int(redis["deploy"]["resources"]["limits"]["memory"].removesuffix("M"))


def test_programs_wait_for_redis_share_the_state_and_are_built_here() -> None:
    for name in ("api", "worker", "worker-gpu"):
        service = services()[name]
        assert service["depends_on"] == {"redis": {"condition": "service_healthy"}}
        assert service["volumes"] == ["state:/var/lib/regnf", "redis:/run/redis:ro"]
        assert service["environment"].items() >= {
            ("REGNF_REDIS_PASSWORD", "@/run/redis/password"),
            ("REGNF_STATE_DIR", "/var/lib/regnf"),
            ("REGNF_REDIS_URL", "redis://redis:6379/0"),
        }
        context = (COMPOSE.parent / service["build"]["context"]).resolve()
        assert context == ROOT
        assert (context / service["build"]["dockerfile"]).is_file()


def test_only_the_proxy_can_be_reached_and_only_from_this_machine() -> None:
    published = {name: service["ports"] for name, service in services().items() if "ports" in service}
    assert published == {
        "proxy": ["${REGNF_PUBLISH:-127.0.0.1:8080}:8000"],
        "grafana": ["${GRAFANA_PUBLISH:-127.0.0.1:3000}:3000"],
    }
    assert compose()["networks"]["inside"] == {"internal": True}
    assert compose()["networks"]["records"] == {"internal": True}
    for name in ("redis", "worker", "worker-gpu"):
        assert services()[name]["networks"] == ["records"]
    assert services()["api"]["networks"] == ["records", "inside", "outside"]
    for name in ("prometheus", "grafana"):
        assert "records" not in services()[name]["networks"], "it has no business with Redis"


def test_defaults_are_settings_that_can_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment that compose hands over by default is one that Settings understands."""
    for name in ("api", "worker"):
        for variable, value in services()[name]["environment"].items():
            default = re.fullmatch(r"\$\{\w+:-(.*)\}", value)
            monkeypatch.setenv(variable, default[1] if default else value.removeprefix("@"))
    settings = Settings()
    found = settings.host, settings.api_tokens, settings.allow_unauthenticated, settings.threads
    assert found == ("0.0.0.0", frozenset(), False, 2)
