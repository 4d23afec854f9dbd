"""``regnf manual``: the pages of the documentation that messages name, for those who have no checkout."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer
from rich.markdown import Markdown
from rich.table import Table

from regnf_cli.report import out, say
from regnf_core.errors import InvalidInputError, suggestion

_PACKAGED = Path(__file__).with_name("manual_pages")
_CHECKOUT = Path(__file__).resolve().parents[1] / "docs"
_LEFT_OUT = ("adr/*", "reference/*", "benchmarks/*")
"""Made for the site, or for who works on regnf itself."""


def manual(
    page: Annotated[str | None, typer.Argument(help="Name of the page. Without it, all pages are listed.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Print the Markdown source.")] = False,
) -> None:
    """Print a page of the manual.

    Example: **regnf manual families**
    """
    pages = pages_of(folder())
    if page is None:
        _list(pages)
        return
    text = pages[_known(page, pages)].read_text(encoding="utf-8")
    if raw or not out.is_terminal:
        say(text)
    else:
        with out.pager(styles=True):
            out.print(Markdown(text))


def folder() -> Path:
    """Where the pages are: in the installed package, or in a checkout. Raises InvalidInputError (MANUAL_MISSING)."""
    for found in (_PACKAGED, _CHECKOUT):
        if found.is_dir():
            return found
    message = f"the manual was not found in {_PACKAGED} or {_CHECKOUT}"
    raise InvalidInputError(message, reason="MANUAL_MISSING", hint="Install regnf from its wheel.")


def pages_of(root: Path) -> dict[str, Path]:
    """The pages below ``root`` by their names, which are their paths without ``.md``."""
    paths = [path.relative_to(root) for path in sorted(root.rglob("*.md"))]
    return {
        path.with_suffix("").as_posix(): root / path
        for path in paths
        if not any(path.match(pattern) for pattern in _LEFT_OUT)
    }


def _known(name: str, pages: dict[str, Path]) -> str:
    """The page that is meant; its folder need not be said. Raises InvalidInputError (MANUAL_PAGE_UNKNOWN)."""
    asked = name.removeprefix("docs/").removesuffix(".md")
    if asked in pages:
        return asked
    found = [one for one in pages if one.rpartition("/")[2] == asked]
    if len(found) == 1:
        return found[0]
    several = " and ".join(f"`{one}`" for one in found)
    hint = f"There are {several}." if found else suggestion(asked, pages) or "`regnf manual` lists all pages."
    raise InvalidInputError(f"{name}: no such page of the manual", reason="MANUAL_PAGE_UNKNOWN", hint=hint)


def _list(pages: dict[str, Path]) -> None:
    table = Table("page", "about", box=None, header_style="bold")
    for name, path in pages.items():
        title = re.search(r"^# (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        table.add_row(name, "" if title is None else title[1].replace("`", ""))
    out.print(table)
