"""Hand this machine's pip configuration to a build, without naming any of it in the repository.

    python -m scripts.images.pip_settings FILE

Writes what `pip config list` says, files and environment together, to FILE and prints the volumes that a build needs to
see the same: FILE as /etc/pip.conf, and every file and folder of this machine that the configuration names.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

_LINE = re.compile(r"^(:env:|[\w-]+)\.([\w-]+)=(.*)$")
_FILE_URL = "file://"


def merged(listing: str) -> dict[str, str]:
    """The options by name as pip itself would take them: the environment goes before the files."""
    found = [match.groups() for line in listing.splitlines() if (match := _LINE.match(line))]
    in_files = {name: str(ast.literal_eval(value)) for section, name, value in found if section == "global"}
    return in_files | {name: str(ast.literal_eval(value)) for section, name, value in found if section == ":env:"}


def as_file(options: dict[str, str]) -> str:
    """The options as a pip.conf."""
    lines = [f"{name} = {' '.join(value.split())}" for name, value in sorted(options.items())]
    return "\n".join(["[global]", *lines, ""])


def named_paths(options: dict[str, str]) -> set[Path]:
    """The files and folders of this machine that the options name; of an index also what lies beside its pages."""
    found = set()
    for word in " ".join(options.values()).split():
        path = Path(word.removeprefix(_FILE_URL))
        if path.is_absolute() and path.exists():
            is_index = word.startswith(_FILE_URL) and path.parent != Path("/")
            found.add(path.parent if is_index else path)
    return found


def main(target: Path) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "config", "list"]
    listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    options = merged(listing)
    target.write_text(as_file(options), encoding="utf-8")
    print(f"{target.resolve()}:/etc/pip.conf:ro")
    for path in sorted(named_paths(options)):
        print(f"{path}:{path}:ro")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
