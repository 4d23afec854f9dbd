"""Figures on the pages: those of the release are what its results say, of the engine that is shipped; of every other
one it is said here what it is."""

from __future__ import annotations

import re

import pytest

from benchmarks import release
from regnf_core.version import ENGINE_REVISION
from tests.docs.pages import DOCS, ROOT

STALE: dict[str, str] = {}
"""Rows of release.json that are not of the shipped engine, by id, and why."""

DEFINITIONS: dict[str, tuple[str, ...]] = {
    "the limit of a correct pose": ("5 % of the",),
    "the confidence of a bound": ("one-sided 95 % bound",),
    "what is said of the scale": ("determines the scale within 1 %",),
    "a feature of the verdict": ("more than 3 % of the diameter off it",),
    "the preset `paper`, its settings": (
        "outside the box enlarged by 5 %", "fewer than 80 % of |r| within 1.5 %", "of all above 3 %",
    ),
    "settings of fits, editing, pictures and readers": (
        "after 3, 10 and 30 %", "from 15 % of the training", "grown by 5 % of", "within 1.5 % of the diagonal",
        "more than 5 % of an object's matter", "or 1 % of the diagonal", "at 1.5 % of the diameter",
    ),
    "settings of the recorded rooms": ("20 % larger than the thing, and shifted by up to 5 %",),
    "an example of what is printed": ("73 % of the volume is free, 23 % unobserved",),
    "what a case and a symmetry of the random worlds are": (
        "30 % (long), 25 % (short) or 12 % (single)", "99 % of the exact mesh within 1 %", "within 3 % count as round",
        "3 to 10 % longer", "less than 2 % of both surfaces",
    ),
}  # fmt: skip
"""Figures that are no measurements: what they are, and the phrases that they stand in."""

PHRASES = [phrase for phrases in DEFINITIONS.values() for phrase in phrases]
FIGURE = re.compile(r"\b\d[\d,]* +of +\d[\d,]*(?: +\(\d+(?:\.\d+)? %\))?|(?<![\d.])\d+(?:\.\d+)? *%")
PAGES = [ROOT / "README.md", *(page for page in sorted(DOCS.rglob("*.md")) if "adr" not in page.parts)]


@pytest.fixture(scope="module")
def rows() -> list[release.Row]:
    return release.rows()


def test_every_row_is_of_the_shipped_engine(rows: list[release.Row]) -> None:
    assert len({row.id for row in rows}) == len(rows) > 30
    assert {row.id: row.revision for row in rows if row.revision != ENGINE_REVISION}.keys() == STALE.keys()


def test_the_pages_show_what_the_results_say(rows: list[release.Row]) -> None:
    for path, text in release.pages(rows).items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: python -m benchmarks.release write"


def test_the_pages_have_their_tables() -> None:
    shown = {path: re.findall(r"<!-- release-table(?:: (\w+))? -->\n\n\|", path.read_text()) for path in PAGES}
    assert shown[ROOT / "README.md"] == [""]
    assert shown[DOCS / "benchmark.md"] == ["right", "answers", "wrong", "variants", "time", "peers"]


def test_a_row_of_another_engine_says_so(rows: list[release.Row]) -> None:
    (one,) = [row for row in rows if row.id == "right/exact"]
    old = release.Row(**{**vars(one), "revision": ENGINE_REVISION - 1})
    assert f"{one.what} (engine revision {ENGINE_REVISION - 1}) |" in release.table("right", [old])
    assert release.revision_of([{"revision": 1}, {"revision": 2}]) is None
    assert release.revision_of([{}]) is None


def words_of(text: str) -> str:
    """Without code blocks and the release's tables, in one line: a phrase may lie on two lines of a page. Every
    character keeps its place."""
    apart = r"^```.*?^```$|<!-- release-table.*?<!-- /release-table -->"
    return re.sub(apart, lambda part: " " * len(part[0]), text, flags=re.M | re.S).replace("\n", " ")


def phrase_around(words: str, figure: re.Match[str]) -> str | None:
    """The phrase of the table above that has the figure at this place."""
    for phrase in PHRASES:
        first = max(0, figure.end() - len(phrase))
        if first <= words.find(phrase, first, figure.start() + len(phrase)) <= figure.start():
            return phrase
    return None


def test_every_figure_is_of_a_row_or_defined(rows: list[release.Row]) -> None:
    values = {value for row in rows for value in row.figures.values()}
    known = values | {value.partition(" (")[0] for value in values}
    unknown, used = [], set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        words = words_of(text)
        for figure in FIGURE.finditer(words):
            phrase = phrase_around(words, figure)
            used.add(phrase)
            if phrase is None and " ".join(figure[0].split()) not in known:
                unknown.append(f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, figure.start()) + 1}: {figure[0]}")
    assert unknown == [], "\n".join(["figures without a row:", *unknown])
    assert set(PHRASES) - used == set(), "phrases that no page has"
