"""The Helm chart, rendered by Helm itself: hardened, complete, and naming only what exists."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from regnf_service.http.hosts import AllowedHosts
from regnf_state.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "deploy/helm/regnf"
HELM = Path(sys.executable).with_name("helm")
SETTINGS = {f"REGNF_{name.upper()}" for name in Settings.model_fields}
OPEN = ["auth.allowUnauthenticated=true"]
S3 = ["storage.kind=s3", "storage.s3.url=s3://bucket/regnf"]
FULL = ["auth.existingSecret=callers", "redis.existingSecret=redis", "autoscaling.enabled=true", *S3,
        "queue.existingSecret=signer", "storage.s3.existingSecret=keys", "metrics.serviceMonitor=true",
        "worker.device=cuda",
        "webhooks.hosts={hooks.example.org,http://10.0.0.1:80}", "webhooks.existingSecret=hooks",
        "api.ingress.enabled=true", "api.ingress.host=regnf.example.org", "api.ingress.tlsSecret=tls",
        "settings.REGNF_JOB_RETENTION_S=3600"]  # fmt: skip

SERVICE_DOMAINS = ("", ".lab", ".lab.svc", ".lab.svc.cluster.local")


def helm(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(HELM), *arguments], capture_output=True, text=True, check=False)


def render(settings: list[str]) -> dict[tuple[str, str], dict[str, Any]]:
    """Every document by kind and name."""
    sets = [word for one in settings for word in (("--set-string" if "REGNF_" in one else "--set"), one)]
    done = helm("template", "demo", str(CHART), "--namespace", "lab", *sets)
    assert done.returncode == 0, done.stderr
    documents = [document for document in yaml.safe_load_all(done.stdout) if document]
    return {(document["kind"], document["metadata"]["name"]): document for document in documents}


@pytest.fixture(scope="module", params=[OPEN, FULL], ids=["plain", "full"])
def rendered(request: pytest.FixtureRequest) -> dict[tuple[str, str], dict[str, Any]]:
    return render(request.param)


def pods(rendered: dict[tuple[str, str], dict[str, Any]]) -> dict[str, dict[str, Any]]:
    kinds = ("Deployment", "StatefulSet")
    return {name: one["spec"]["template"]["spec"] for (kind, name), one in rendered.items() if kind in kinds}


def environment(pod: dict[str, Any]) -> dict[str, Any]:
    return {one["name"]: one.get("value", one.get("valueFrom")) for one in pod["containers"][0]["env"]}


def test_helm_finds_no_fault() -> None:
    done = helm("lint", "--strict", str(CHART), "--set", OPEN[0])
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_pod_is_hardened(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    assert {"demo-api", "demo-worker"} <= pods(rendered).keys()
    for pod in pods(rendered).values():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] > 0
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        for container in pod["containers"]:
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False,
                "readOnlyRootFilesystem": True,
                "capabilities": {"drop": ["ALL"]},
            }
            assert "memory" in container["resources"]["limits"]
            assert {"startupProbe", "livenessProbe"} <= container.keys()
            mounted = {mount["name"] for mount in container["volumeMounts"]}
            assert "tmp" in mounted
            assert mounted - {volume["name"] for volume in pod["volumes"]} <= {"data"}


def test_strangers_reach_the_proxy_alone(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    """The configuration is the compose file's; `api` in it is the pod's own loopback."""
    pod = pods(rendered)["demo-api"]
    (proxy,) = [one for one in pod["containers"] if one["name"] == "proxy"]
    (http,) = rendered["Service", "demo-api"]["spec"]["ports"]
    assert proxy["ports"] == [{"name": http["targetPort"], "containerPort": 8000}]
    assert rendered["ConfigMap", "demo-proxy"]["data"].keys() == {"nginx.conf", "start.sh"}
    assert pod["hostAliases"] == [{"ip": "127.0.0.1", "hostnames": ["api"]}]
    assert environment(pod)["REGNF_BEHIND_PROXY"] == "true"


def test_every_variable_is_a_setting_and_no_secret_is_a_value(
    rendered: dict[tuple[str, str], dict[str, Any]],
) -> None:
    for name in ("demo-api", "demo-worker"):
        told = environment(pods(rendered)[name])
        assert told.keys() <= SETTINGS
        secrets = {name: told[name] for name in ("REGNF_API_TOKENS", "REGNF_WEBHOOK_SECRETS") if name in told}
        assert all(value.startswith("@/") for value in secrets.values())
        assert not (secrets and name == "demo-worker")


def test_labels_find_their_pods(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    labels = [one["spec"]["template"]["metadata"]["labels"].items() for one in rendered.values()
              if "template" in one.get("spec", {})]  # fmt: skip
    assert {"Service", "Deployment"} <= {kind for kind, _ in rendered}
    for (kind, name), one in rendered.items():
        if kind == "Service":
            assert any(one["spec"]["selector"].items() <= pod for pod in labels), name
        if kind in ("Deployment", "StatefulSet"):
            assert (
                one["spec"]["selector"]["matchLabels"].items() <= one["spec"]["template"]["metadata"]["labels"].items()
            )


def test_ports_lead_somewhere(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    containers = [container for pod in pods(rendered).values() for container in pod["containers"]]
    ports = {port["name"] for container in containers for port in container.get("ports", [])}
    asked = [{port["targetPort"] for port in one["spec"]["ports"]} for (kind, _), one in rendered.items()
             if kind == "Service"]  # fmt: skip
    assert asked
    assert all(some and some <= ports for some in asked)


def test_plain_brings_its_own_redis_and_volume() -> None:
    plain = render(OPEN)
    redis = plain["StatefulSet", "demo-redis"]["spec"]["template"]["spec"]["containers"][0]
    assert "--appendonly yes" in " ".join(redis["command"])
    assert "noeviction" in redis["command"]
    api = pods(plain)["demo-api"]
    assert environment(api)["REGNF_REDIS_URL"] == {"secretKeyRef": {"name": "demo-redis", "key": "url"}}
    secret = plain["Secret", "demo-redis"]["stringData"]
    assert len(secret["password"]) == 48
    assert secret["url"] == f"redis://:{secret['password']}@demo-redis:6379/0"
    assert secret["users.acl"].startswith(f"user default on >{secret['password']} ")
    assert "-config" in secret["users.acl"].split()
    assert "--aclfile /etc/redis/users.acl" in " ".join(redis["command"])
    given = render([*OPEN, "redis.password=abcdefghijklmnop"])["Secret", "demo-redis"]["stringData"]
    assert given["password"] == "abcdefghijklmnop"
    assert environment(api)["REGNF_ALLOW_UNAUTHENTICATED"] == "true"
    claim = plain["PersistentVolumeClaim", "demo-state"]
    assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
    volume = next(one for one in api["volumes"] if one["name"] == "state")
    assert volume["persistentVolumeClaim"]["claimName"] == "demo-state"
    assert plain["Deployment", "demo-worker"]["spec"]["replicas"] == 1
    egress = plain["NetworkPolicy", "demo-worker"]["spec"]["egress"]
    assert [port["port"] for rule in egress for port in rule["ports"]] == [6379, 53, 53]


def test_full_uses_what_is_there() -> None:
    full = render(FULL)
    assert not [name for kind, name in full if kind in ("StatefulSet", "PersistentVolumeClaim")]
    api, worker = pods(full)["demo-api"], pods(full)["demo-worker"]
    told = environment(api)
    assert told["REGNF_REDIS_URL"] == {"secretKeyRef": {"name": "redis", "key": "url"}}
    assert told["REGNF_STORAGE_URL"] == "s3://bucket/regnf"
    assert json.loads(told["REGNF_WEBHOOK_HOSTS"]) == ["hooks.example.org", "http://10.0.0.1:80"]
    assert told["REGNF_JOB_RETENTION_S"] == "3600"
    mounts = {one["mountPath"]: one["name"] for one in api["containers"][0]["volumeMounts"]}
    assert told["REGNF_API_TOKENS"][1:].rpartition("/")[0] in mounts
    assert told["REGNF_WEBHOOK_SECRETS"][1:].rpartition("/")[0] in mounts
    assert worker["containers"][0]["envFrom"] == [{"secretRef": {"name": "keys"}}]
    assert worker["containers"][0]["resources"]["limits"] == {"memory": "12Gi", "nvidia.com/gpu": 1}
    assert environment(worker)["REGNF_DEVICE"] == "cuda"
    assert "replicas" not in full["Deployment", "demo-worker"]["spec"], "the autoscaler's to say"


def test_front_end_and_workers_sign_the_queue_with_one_key() -> None:
    for settings, name in ((OPEN, "demo-queue"), (FULL, "signer")):
        rendered = render(settings)
        told = [environment(pods(rendered)[pod])["REGNF_QUEUE_KEY"] for pod in ("demo-api", "demo-worker")]
        assert told == [{"secretKeyRef": {"name": name, "key": "key"}}] * 2
        assert (("Secret", name) in rendered) == (settings is OPEN)
    drawn = [render(OPEN)["Secret", "demo-queue"]["stringData"]["key"] for _ in range(2)]
    assert [len(key) for key in drawn] == [48, 48]
    assert drawn[0] != drawn[1]
    given = render([*OPEN, "queue.key=abcdefghijklmnop"])["Secret", "demo-queue"]["stringData"]
    assert given == {"key": "abcdefghijklmnop"}


def test_workers_are_scaled_by_what_is_unfinished() -> None:
    full = render(FULL)
    scaled = full["ScaledObject", "demo-worker"]["spec"]
    assert ("Deployment", scaled["scaleTargetRef"]["name"]) in full
    (trigger,) = scaled["triggers"]
    metrics = full["Service", "demo-metrics"]["spec"]["ports"][0]
    assert trigger["metadata"]["url"] == f"http://demo-metrics.lab.svc:{metrics['port']}/metrics"
    assert trigger["metadata"]["valueLocation"] == "regnf_unfinished"
    assert '"unfinished"' in (ROOT / "service/regnf_service/metrics.py").read_text()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ([], "auth.existingSecret"), ([*OPEN, "storage.kind=nfs"], "storage"),
        ([*OPEN, "redis.password=a b"], "password"), ([*OPEN, "queue.key=short"], "queue"),
        ([*OPEN, "settings.REGNF_QUEUE_KEY=abcdefghijklmnop"], "settings"),
        ([*OPEN, "storage.kind=s3"], "storage.s3.url"), ([*OPEN, "worker.device=tpu"], "device"),
        ([*OPEN, "api.replicas=0"], "replicas"),
        ([*OPEN, "webhooks.hosts={a.example.org}"], "webhooks.existingSecret"),
        ([*OPEN, "settings.REGNF_API_TOKENS=x"], "settings"), ([*OPEN, "wroker.replicas=2"], "wroker"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused(settings: list[str], said: str) -> None:
    sets = [word for one in settings for word in ("--set", one)]
    done = helm("template", "demo", str(CHART), *sets)
    assert done.returncode != 0
    assert said in done.stderr


def test_the_front_end_knows_its_names() -> None:
    for settings, more in (
        (OPEN, set()),
        ([*FULL, "api.allowedHosts={balancer.lan}"], {"regnf.example.org", "balancer.lan"}),
    ):
        value = environment(pods(render(settings))["demo-api"])["REGNF_ALLOWED_HOSTS"]
        services = {f"demo-{name}{domain}" for name in ("api", "metrics") for domain in SERVICE_DOMAINS}
        assert set(json.loads(value)) == services | more
        AllowedHosts(json.loads(value))
