"""The site is built without a warning, and a reader without a network misses nothing of it."""

from __future__ import annotations

import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from scripts.docs_site.lists import with_plain_lists
from scripts.docs_site.repository_links import DOCS, ROOT, files_outside_docs, with_site_links


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    offline = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9", "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | offline, capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class Page(HTMLParser):
    """What a page loads, what it leads to, and what can be led to in it."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.ids |= {values[name] for name in ("id", "name") if name in values}
        if "src" in values:
            self.loads.append(values["src"])
        if "href" in values:
            (self.links if tag == "a" else self.loads).append(values["href"])


def test_every_link_of_the_site_leads_somewhere(site: Path) -> None:
    pages = {file.resolve(): Page(file) for file in site.rglob("*.html")}
    assert len(pages) > 60
    dead = []
    for file, page in pages.items():
        if file.name == "404.html":
            continue  # its links are of the server's root
        for link in [*page.links, *page.loads]:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            target = target / "index.html" if target.is_dir() else target
            known = pages[target].ids if target in pages else set()
            if not target.is_file() or (parts.fragment and target in pages and unquote(parts.fragment) not in known):
                dead.append((file.relative_to(site.resolve()).as_posix(), link))
    assert dead == []


def test_the_made_pages_are_there_and_load_nothing_from_elsewhere(site: Path) -> None:
    for file in site.rglob("*.html"):
        assert [load for load in Page(file).loads if urlsplit(load).netloc] == [], file
    for sheet in site.rglob("*.css"):
        assert "url(http" not in sheet.read_text(encoding="utf-8")
    commands = (site / "reference" / "command-line.html").read_text(encoding="utf-8")
    assert all(f"regnf {name}" in commands for name in ("register", "search", "serve", "fuse"))
    assert "worker-timeout" in commands
    assert "/register" in (site / "reference" / "http.html").read_text(encoding="utf-8")
    assert "T_object_scene" in (site / "reference" / "python.html").read_text(encoding="utf-8")


def test_links_out_of_docs_lead_into_the_site() -> None:
    text = "[a](../benchmarks/results/real.md) [b](adr/) [c](https://a.example/x.md)\n```\n[d](../README.md)\n```\n"
    moved = with_site_links(text, "api.md")
    assert "[a](benchmarks/results/real.md) [b](adr/README.md) [c](https://a.example/x.md)" in moved
    assert "[d](../README.md)" in moved
    assert DOCS / "api.md" not in files_outside_docs()
    assert with_site_links("[e](../docs/api.md)", "benchmarks/README.md") == "[e](../api.md)"


def test_lists_are_written_for_the_converter() -> None:
    written = {
        "Text:\n- a\n- b": "Text:\n\n- a\n- b",
        "1. a\n   - b\n     c\n2. d": "1. a\n    - b\n        c\n2. d",
        "- a\n\n  b\n\nc": "- a\n\n    b\n\nc",
        "The result of\n2. is no list": "The result of\n2. is no list",
        "```\n- a\n  - b\n```": "```\n- a\n  - b\n```",
    }
    assert {text: with_plain_lists(text) for text in written} == written
