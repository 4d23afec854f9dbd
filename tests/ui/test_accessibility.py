"""axe-core finds no serious fault on any page, in both themes."""

from __future__ import annotations

from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.ui.conftest import Visit
from tests.ui.home import CHAIR, click_at, give_files, open_page

pytestmark = pytest.mark.browser
THEMES = ("light", "dark")


def faults_in(page: Page) -> list[str]:
    """What axe-core calls serious or critical: the rule and the elements."""
    found = Axe().run(page).response["violations"]
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    return [f"{one['id']}: {[node['html'][:120] for node in one['nodes']]}" for one in serious]


def in_both_themes(page: Page) -> dict[str, list[str]]:
    found = {}
    for theme in THEMES:
        page.emulate_media(color_scheme=theme, reduced_motion="reduce")
        found[theme] = faults_in(page)
    return found


NONE: dict[str, list[str]] = {theme: [] for theme in THEMES}


def test_home_page_empty_and_at_work(visit: Visit, service: str, files: tuple[Path, Path, Path]) -> None:
    page = visit.page
    open_page(page, service)
    assert in_both_themes(page) == NONE
    give_files(page, files)
    click_at(page, CHAIR)
    expect(page.locator("#boxes li")).to_have_count(1)
    page.locator("#options summary").click()
    page.locator("#numbers summary").click()
    assert in_both_themes(page) == NONE
    page.click("#register")
    page.wait_for_selector(".run[data-verdict]")
    assert in_both_themes(page) == NONE
    for address in ("/jobs", "/fields"):
        page.goto(service + address)
        page.wait_for_selector(".tile canvas" if address == "/fields" else ".tile")
        assert in_both_themes(page) == NONE, address
    page.goto(f"{service}/jobs")
    page.get_by_role("button", name="Run again").click()
    expect(page.locator("#again-dialog")).to_be_visible()
    assert in_both_themes(page) == NONE


def test_documentation(visit: Visit, service: str) -> None:
    visit.page.goto(f"{service}/docs")
    visit.page.wait_for_selector("h1")
    assert in_both_themes(visit.page) == NONE
    visit.page.goto("about:blank")


@pytest.mark.parametrize("story", ["done", "running", "failed", "searched", "rendered", "locked"])
def test_page_of_a_job(visit: Visit, story: str) -> None:
    page = visit.page
    page.goto(visit.server.view(story))
    if story == "running":
        expect(page.locator("#message-title")).to_have_text("Optimizing")
    else:
        page.wait_for_selector("html[data-page=ready]")
    assert in_both_themes(page) == NONE


def test_rule_that_is_broken_is_found(visit: Visit, service: str) -> None:
    visit.page.goto(f"{service}/fields")
    visit.page.wait_for_selector("html[data-page=ready]")
    visit.page.evaluate("() => document.querySelector('#list').append(document.createElement('button'))")
    assert any(fault.startswith("button-name") for fault in faults_in(visit.page))
    visit.page.goto("about:blank")
