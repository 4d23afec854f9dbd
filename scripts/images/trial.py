"""Run every documented compose command through the built images: `scripts/images.sh try` calls it.

    python -m scripts.images.trial BUILDAH [OPTION ...]

In a network namespace of its own, where each service has an address that is not loopback, as on compose's networks.
Each command's environment starts Redis, the front end and its workers; two fields are uploaded and a registration goes
through API, Redis and worker; its transform is compared with the truth. Commands that come to the same are run once.
Services whose images come from a registry are rendered, not run.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from regnf_cli.demo import MAX_CENTER_SHARE, MAX_ROTATION_RAD, MAX_SCALE_SHARE
from regnf_cli.embedded_redis import answers, server_binary
from regnf_client import Client
from regnf_core.errors import RegnfError
from scripts.images.commands import ComposeCommand, documented_commands
from scripts.images.compose import Service, render
from scripts.images.containers import Buildah, Container, TrialError, start_redis

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "examples" / "data"
HOSTS = {"redis": "10.89.0.2", "api": "10.89.0.3"}
USER = 10001
_TRIAL_S = 400


@dataclass(frozen=True)
class Plan:
    """What a command starts, as far as it can be run here."""

    api: Service
    worker: Service
    redis: Service
    workers: int

    @property
    def key(self) -> str:
        return json.dumps([self.api["environment"], self.worker["environment"], self.workers], sort_keys=True)


def plan_of(command: ComposeCommand) -> tuple[Plan | None, list[str]]:
    """The plan, if the command starts a worker that runs here, and the services that are rendered only."""
    services = render(ROOT / command.file, command.variables, command.profiles)
    left_out = [name for name in services if name not in ("redis", "api", "worker")]
    if "worker" not in services:
        return None, left_out
    plan = Plan(services["api"], services["worker"], services["redis"], command.scale.get("worker", 1))
    return plan, left_out


def main(buildah: Buildah) -> None:
    _make_network()
    done: dict[str, str] = {}
    for command in documented_commands(ROOT):
        print(f"\n{command.source}: {command.text}")
        plan, left_out = plan_of(command)
        if left_out:
            print(f"   rendered, not run: {', '.join(left_out)}")
        if plan is None:
            continue
        if plan.key in done:
            print(f"   the same as in {done[plan.key]}")
            continue
        done[plan.key] = command.source
        for program in _redis_programs(first=len(done) == 1):
            with _deadline(_TRIAL_S):
                run(plan, buildah, program)
    print(f"\n{len(done)} different commands run, all good")


def _make_network() -> None:
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    for address in HOSTS.values():
        subprocess.run(["ip", "address", "add", f"{address}/32", "dev", "lo"], check=True)


def _redis_programs(first: bool) -> list[str]:
    """The Valkey that comes as a package, of the version that compose ships; once also a Redis that is installed."""
    other = shutil.which("redis-server") if first else None
    return [server_binary(), *([other] if other else [])]


@contextmanager
def _deadline(seconds: int) -> Iterator[None]:
    def end(*_: object) -> None:
        raise TrialError(f"not done within {seconds} s")

    signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def run(plan: Plan, buildah: Buildah, redis_program: str) -> None:
    """Start everything, register, stop everything."""
    version = subprocess.run([redis_program, "--version"], capture_output=True, text=True, check=True).stdout
    print(f"   on {' '.join(version.split()[:3])}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="regnf-trial-")))
        began = time.monotonic()
        data = folder / "redis"
        data.mkdir()
        redis = start_redis(redis_program, plan.redis, HOSTS["redis"], data)
        stack.callback(redis.wait)
        stack.callback(redis.kill)
        _wait_for_redis(redis, data / "password")
        containers = []
        for container in _containers(plan, buildah, folder):
            stack.callback(container.close)
            containers.append(container)
            container.start()
        for container in containers:
            container.wait_until_healthy()
        print(f"   redis, api and {plan.workers} worker(s) healthy after {time.monotonic() - began:.1f} s")
        try:
            use(plan)
        except (RegnfError, httpx.HTTPError, TrialError) as error:
            logs = [f"--- {container.name}\n{container.log_tail()}" for container in containers]
            raise TrialError("\n".join([f"{type(error).__name__}: {error}", *logs])) from error
        began = time.monotonic()
        for container in containers:
            container.stop()
        print(f"   stopped in {time.monotonic() - began:.1f} s")
        if strays := [path for container in containers for path in container.strays()]:
            raise TrialError(f"written outside of the volumes: {', '.join(strays)}")


def _wait_for_redis(redis: subprocess.Popen[bytes], password: Path) -> None:
    deadline = time.monotonic() + 20
    while not (password.exists() and answers(f"redis://:{password.read_text()}@{HOSTS['redis']}:6379/0")):
        if redis.poll() is not None or time.monotonic() > deadline:
            raise TrialError("Redis does not answer")
        time.sleep(0.05)


def _containers(plan: Plan, buildah: Buildah, folder: Path) -> Iterator[Container]:
    state = folder / "state"
    state.mkdir(mode=0o750)
    folder.chmod(0o755)
    shutil.chown(state, USER, USER)
    services = {"api": plan.api} | {f"worker-{number}": plan.worker for number in range(plan.workers)}
    for name, service in services.items():
        yield Container(
            buildah, name, service, {"state": state, "redis": folder / "redis"}, HOSTS, folder / f"{name}.log"
        )


def use(plan: Plan) -> None:
    """One registration, as a client that has the first of the tokens or none if none is requested."""
    address = f"http://{HOSTS['api']}:8080"
    tokens: list[str] = json.loads(plan.api["environment"]["REGNF_API_TOKENS"])
    token = tokens[0].split(":", 1)[-1] if tokens else None
    known = {"Authorization": f"Bearer {token}"} if token else {}
    _expect(f"{address}/readyz", {}, 401 if token else 200)
    _expect(f"{address}/readyz", known, 200)
    _expect(f"{address}/healthz", {}, 200)
    print(f"   asks for {'a' if token else 'no'} token")
    with Client(address, token) as service:
        began = time.monotonic()
        room, chair = (service.upload(DATA / f"{name}.safetensors") for name in ("mix-room", "armchair"))
        uploaded = time.monotonic()
        box = json.loads((DATA / "detection.json").read_text(encoding="utf-8"))
        result = service.register(room, chair, box).document
        print(f"   fields ready after {uploaded - began:.1f} s, registered in {time.monotonic() - uploaded:.1f} s")
    check(result)


def _expect(address: str, headers: dict[str, str], status: int) -> None:
    answer = httpx.get(address, headers=headers)
    if answer.status_code != status:
        raise TrialError(f"{address} answers {answer.status_code}, not {status}: {answer.text}")


def check(result: dict[str, Any]) -> None:
    """Raises TrialError unless the object is registered where the truth has it."""
    truth = json.loads((DATA / "truth.json").read_text(encoding="utf-8"))
    found, true = (np.array(one["T_object_scene"]["matrix"]) for one in (result, truth))
    scale, true_scale = (float(np.cbrt(np.linalg.det(matrix[:3, :3]))) for matrix in (found, true))
    between = found[:3, :3] @ true[:3, :3].T / (scale * true_scale)
    rotation = float(np.arccos(np.clip((np.trace(between) - 1.0) / 2.0, -1.0, 1.0)))
    center = np.array([*result["center_object"], 1.0])
    apart = float(np.linalg.norm(np.linalg.inv(found) @ center - np.linalg.inv(true) @ center))
    off = apart * true_scale / truth["object_diameter"]
    size = abs(scale / true_scale - 1.0)
    print(
        f"   {result['verdict']}: off by {rotation:.4f} rad, its center by {100 * off:.2f} % of the diameter, "
        f"{100 * size:.2f} % in scale"
    )
    bounds = (MAX_ROTATION_RAD, MAX_CENTER_SHARE, MAX_SCALE_SHARE)
    good = all(value <= bound for value, bound in zip((rotation, off, size), bounds, strict=True))
    if result["verdict"] != "registered" or not good:
        raise TrialError(f"not registered where the truth has it: {json.dumps(result['T_object_scene'])}")


if __name__ == "__main__":
    try:
        main(Buildah(sys.argv[1:]))
    except TrialError as error:
        sys.exit(f"failed: {error}")
