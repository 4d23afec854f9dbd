"""Links from the pages to files of the repository outside of docs/. They become pages or files of the site.

So the site needs no other place, and the same links work where the repository is browsed. A linked Markdown file
becomes a page, any other file is copied. A folder stands for its README.md.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
_LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")
_ELSEWHERE = ("http://", "https://", "mailto:", "#", "/")


def site_name(file: Path) -> str:
    """Where a file of the repository lies within the site's sources: docs/ is the top, all else keeps its path."""
    if file == ROOT / "README.md":
        return "index.md"
    if file.is_relative_to(DOCS):
        return file.relative_to(DOCS).as_posix()
    return file.relative_to(ROOT).as_posix()


def repository_file(name: str) -> Path:
    """The file of the repository that has this name within the site's sources."""
    return DOCS / name if (DOCS / name).exists() else ROOT / name


def linked(file: Path, target: str) -> Path | None:
    """The file of the repository that a link in ``file`` means; None for other sites, and for what is not there."""
    if target.startswith(_ELSEWHERE):
        return None
    found = (file.parent / target).resolve()
    if found.is_dir():
        found = found / "README.md"
    return found if found.is_file() and found.is_relative_to(ROOT) else None


def _outside_fences(text: str, change: Callable[[str], str]) -> str:
    parts = re.split(r"(^ *```.*?^ *```$)", text, flags=re.M | re.S)
    return "".join(part if number % 2 else change(part) for number, part in enumerate(parts))


def files_outside_docs() -> set[Path]:
    """Every file outside of docs/ that a page links to, and what those pages link to in turn; the contract."""
    waiting, found = sorted(DOCS.rglob("*.md")), {ROOT / "openapi.yaml"}
    while waiting:
        page = waiting.pop()
        for _, target, _ in _LINK.findall(page.read_text(encoding="utf-8")):
            file = linked(page, target)
            if file is None or file in found or file.is_relative_to(DOCS) or file == ROOT / "README.md":
                continue
            found.add(file)
            if file.suffix == ".md":
                waiting.append(file)
    return found


def with_site_links(text: str, name: str) -> str:
    """The Markdown of the page ``name`` with each link to a file as it is within the site."""
    page = repository_file(name)

    def moved(match: re.Match[str]) -> str:
        file = linked(page, match[2])
        if file is None:
            return match[0]
        there = os.path.relpath(site_name(file), PurePosixPath(name).parent)
        return f"{match[1]}{there}{match[3]}"

    return _outside_fences(text, lambda part: _LINK.sub(moved, part))
