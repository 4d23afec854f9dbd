"""The compose commands that the documentation prints, with the variables that it sets for them."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from scripts.images.interpolation import ComposeError

_ASSIGNMENT = re.compile(r"[A-Za-z_][A-Za-z0-9_]*=")
_CODE = re.compile(r"```[^\n]*\n(.*?)```|`([^`\n]*docker compose [^`\n]*)`", flags=re.S)
_CALL = ["docker", "compose"]


@dataclass(frozen=True)
class ComposeCommand:
    """``source`` is the file that prints it, ``text`` the line."""

    source: str
    text: str
    variables: dict[str, str]
    file: str
    profiles: tuple[str, ...]
    action: str
    scale: dict[str, int]


def documented_commands(root: Path) -> list[ComposeCommand]:
    """Every one of the README, the documentation and the comments of the files in docker/."""
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    found = [_command(page, root, line, exports) for page in pages for line, exports in _lines_of_page(page)]
    for path in sorted(filter(Path.is_file, (root / "docker").iterdir())):
        found += [_command(path, root, line, {}) for line in _comments(path)]
    return found


def _lines_of_page(page: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Each command of a page, with what its block exported before it."""
    for block, inline in _CODE.findall(page.read_text(encoding="utf-8")):
        exports: dict[str, str] = {}
        for line in (inline or block).replace("\\\n", " ").splitlines():
            if line.startswith("export "):
                exports |= _assignments(shlex.split(line, comments=True))
            elif "docker compose " in line:
                yield line.strip(), dict(exports)


def _comments(path: Path) -> Iterator[str]:
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#") and "docker compose " in line:
            yield line.lstrip("# ")


def _assignments(words: list[str]) -> dict[str, str]:
    return dict(word.split("=", 1) for word in words if _ASSIGNMENT.match(word))


def _command(source: Path, root: Path, line: str, exports: dict[str, str]) -> ComposeCommand:
    """Raises ComposeError for a line that is no command, or one with options that compose does not know."""
    words = shlex.split(line, comments=True)
    count = next((i for i, word in enumerate(words) if not _ASSIGNMENT.match(word)), len(words))
    if words[count : count + 2] != _CALL:
        raise ComposeError(f"{source.name}: no command of compose: {line}")
    options = _parser().parse_args(words[count + 2 :])
    return ComposeCommand(
        source=str(source.relative_to(root)),
        text=line,
        variables=exports | _assignments(words[:count]),
        file=options.file,
        profiles=tuple(options.profile),
        action=options.action,
        scale={name: int(number) for name, number in (pair.split("=") for pair in getattr(options, "scale", []))},
    )


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ComposeError(message)


def _parser() -> _Parser:
    """The part of compose's command line that the documentation uses."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("-f", "--file", required=True)
    parser.add_argument("--profile", action="append", default=[])
    actions = parser.add_subparsers(dest="action", required=True)
    up = actions.add_parser("up", add_help=False, allow_abbrev=False)
    for flag in ("--build", "--wait"):
        up.add_argument(flag, action="store_true")
    up.add_argument("--scale", action="append", default=[])
    return parser
