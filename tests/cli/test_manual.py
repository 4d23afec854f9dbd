"""The manual at the command line: the pages that messages name are there."""

from __future__ import annotations

import re
from pathlib import Path

from regnf_cli.manual import folder, pages_of
from regnf_core.errors import HINTS
from tests.cli.conftest import Run

ROOT = Path(__file__).parents[2]
NAMED = re.compile(r"\bdocs/([a-z0-9/-]+)\.md\b")


def test_all_pages_are_listed_with_their_titles(run: Run) -> None:
    listed = run("manual").stdout
    assert re.search(r"^ ?how-to/batch +Register many pairs", listed, re.MULTILINE)
    assert "adr/" not in listed


def test_a_page_is_printed_as_it_is_written(run: Run) -> None:
    for name in ("families", "docs/families.md", "how-to/library", "library"):
        page = "docs/families.md" if "families" in name else "docs/how-to/library.md"
        assert run("manual", name).stdout.strip() == (ROOT / page).read_text().strip()
    several = "There are `concepts/verdicts` and `how-to/verdicts`"
    for name, hint in (("familys", "`families`"), ("../README", "`regnf manual`"), ("verdicts", several)):
        ended = run("manual", name)
        assert (ended.code, "MANUAL_PAGE_UNKNOWN" in ended.stderr, hint in ended.stderr) == (2, True, True)


def test_every_page_that_a_message_names_is_there() -> None:
    pages = pages_of(folder())
    sources = [path for top in ("regnf_cli", "regnf_core", "regnf_state") for path in (ROOT / top).rglob("*.py")]
    named = {name for path in sources for name in NAMED.findall(path.read_text())}
    hinted = {name for hint in HINTS.values() for name in NAMED.findall(hint)}
    assert {"families", "import-gate", "how-to/library"} <= named | hinted
    assert hinted | {name for name in named if not name.startswith(("adr/", "reference/"))} <= set(pages)


def test_hints_name_the_command(tmp_path: Path, run: Run) -> None:
    picture = tmp_path / "photo.webp"
    picture.write_bytes(b"RIFF\x00\x01\x00\x00WEBP" + bytes(600))
    assert "`regnf manual import-gate`" in run("inspect", picture).stderr
