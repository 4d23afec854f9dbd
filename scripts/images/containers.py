"""Compose's services as processes: containers by `buildah run`, and a Redis server of this machine.

A container gets the command, environment, user, volumes, temporary folders, capabilities and health check that the
compose file and its image give it. It does not get the limits of memory and processes, and its root is not mounted
read-only: ``strays`` tells what a service has written there.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scripts.images.compose import Service

_HEALTHY_S = 90.0
_REDIS_SCRIPT = Path(__file__).resolve().parents[2] / "docker/redis.sh"


class TrialError(Exception):
    """What the images do not do as they should."""


@dataclass(frozen=True)
class Buildah:
    """The program with the options that name its storage."""

    command: list[str]

    def __call__(self, *words: str) -> str:
        done = subprocess.run([*self.command, *words], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise TrialError(f"buildah {words[0]}: {done.stderr.strip()}")
        return done.stdout.strip()


@dataclass
class Container:
    """A service of the compose file, made from its image. ``volumes`` are folders of this machine by name."""

    buildah: Buildah
    name: str
    service: Service
    volumes: dict[str, Path]
    hosts: dict[str, str]
    log: Path
    process: subprocess.Popen[bytes] | None = field(default=None, init=False)
    started: float = field(default_factory=time.time, init=False)

    def __post_init__(self) -> None:
        self.image = f"localhost/{self.service['image']}"
        hosts = [f"--add-host={host}:{address}" for host, address in self.hosts.items()]
        self.id = self.buildah("from", *hosts, self.image)
        described = json.loads(self.buildah("inspect", "--type=image", self.image))
        self._config: dict[str, Any] = described["Docker"]["config"]
        for place in self._config["Volumes"]:
            # buildah mounts one of its own in its place, at times also over one that `run` is given
            self.buildah("config", "--volume", f"{place}-", self.id)

    def _run(self, command: list[str]) -> list[str]:
        options = ["--hostname", self.name]
        options += [f"--cap-drop={name}" for name in self.service["cap_drop"]]
        options += [f"--env={name}={value}" for name, value in self.service["environment"].items()]
        named = [entry.partition(":") for entry in self.service["volumes"]]
        options += [f"--volume={self.volumes[name]}:{place}" for name, _, place in named]
        options += [f"--mount=type=tmpfs,{_tmpfs(entry)}" for entry in self.service["tmpfs"]]
        return [*self.buildah.command, "run", *options, self.id, "--", *command]

    def start(self) -> None:
        with self.log.open("wb") as log:
            command = self.service.get("command") or self._config["Cmd"]
            self.process = subprocess.Popen(self._run(command), stdout=log, stderr=subprocess.STDOUT)

    def wait_until_healthy(self) -> None:
        """By the compose file's own check, run in the container."""
        kind, *check = self.service["healthcheck"]["test"]
        assert kind == "CMD"
        assert self.process is not None
        deadline = time.monotonic() + _HEALTHY_S
        while subprocess.run(self._run(check), capture_output=True, check=False).returncode != 0:
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise TrialError(f"{self.name} is not healthy:\n{self.log_tail()}")
            time.sleep(0.2)

    def log_tail(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")[-3000:]

    def stop(self) -> None:
        """End the program as compose does; raises TrialError when it takes longer than it may."""
        assert self.process is not None
        os.kill(_program_of(self.process.pid), signal.SIGTERM)
        grace_s = float(self.service["stop_grace_period"].removesuffix("s"))
        try:
            self.process.wait(timeout=grace_s)
        except subprocess.TimeoutExpired as error:
            raise TrialError(f"{self.name} has not ended within {grace_s:g} s") from error

    def close(self) -> None:
        """End it at once, if it has not ended."""
        if self.process is not None and self.process.poll() is None:
            os.kill(_program_of(self.process.pid), signal.SIGKILL)
            self.process.wait()

    def strays(self) -> list[str]:
        """Files outside of its volumes that the service has written."""
        root = self.buildah("mount", self.id)
        user = self._config["User"].split(":")[0]
        found = subprocess.run(
            ["find", root, "-xdev", "-user", user, "-newermt", f"@{self.started}"],
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        self.buildah("umount", self.id)
        return [path.removeprefix(root) for path in found.splitlines()]


def _tmpfs(entry: str) -> str:
    place, _, options = entry.partition(":")
    return ",".join([f"destination={place}", *(f"tmpfs-{option}" for option in options.split(",") if option)])


def _program_of(pid: int) -> int:
    """The first process below buildah's own."""
    while Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0].startswith(b"buildah"):
        tasks = Path(f"/proc/{pid}/task").glob("*/children")
        (pid,) = [int(child) for task in tasks for child in task.read_text().split()]
    return pid


def start_redis(program: str, service: Service, address: str, data: Path) -> subprocess.Popen[bytes]:
    """A server of this machine with the options that the compose file gives to its own, and its image's."""
    shell, _, *given = service["command"]
    options = ["--bind", address, "--protected-mode", "no", "--loglevel", "warning"]
    environment = os.environ | {"REDIS_SERVER": program, "REDIS_DATA": str(data), "REDIS_RUN": str(data)}
    command = [shell, str(_REDIS_SCRIPT), *given, *options]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
