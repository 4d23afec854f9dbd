"""The deployment files as data: Dockerfile instructions and the compose document."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILES = (ROOT / "docker" / "service.Dockerfile", ROOT / "docker" / "worker.Dockerfile")
COMPOSE = ROOT / "docker" / "compose.yaml"

Instruction = tuple[str, str]


def instructions(path: Path) -> list[Instruction]:
    """(name, arguments) of each instruction, continuation lines joined, comments left out."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [
        (name.upper(), rest) for name, _, rest in (line.strip().partition(" ") for line in joined.splitlines()) if name
    ]


def last_stage(path: Path) -> list[Instruction]:
    """The instructions from the last FROM on: what ends up in the image."""
    found = instructions(path)
    last = max(i for i, (name, _) in enumerate(found) if name == "FROM")
    return found[last:]


def copied_sources(path: Path) -> list[str]:
    """What is copied from the build context, not from another stage."""
    copies = [
        shlex.split(rest) for name, rest in instructions(path) if name == "COPY" and not rest.startswith("--from")
    ]
    return [source for words in copies for source in words[:-1]]


def command_of(path: Path) -> list[str]:
    """The CMD of the image in its exec form."""
    (command,) = [rest for name, rest in instructions(path) if name == "CMD"]
    parsed: list[str] = json.loads(command)
    return parsed


def compose() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load(COMPOSE.read_text())
    return document


def services() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = compose()["services"]
    return found
