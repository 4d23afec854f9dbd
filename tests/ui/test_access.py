"""The page for everyone: keyboard, screen reader, phone, dark and light; axe-core finds no serious fault."""

from __future__ import annotations

from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.ui.conftest import Files, Visit
from tests.ui.home import CHAIR, blue, click_at, give_files, open_page

pytestmark = pytest.mark.browser
NONE: dict[str, list[str]] = {"dark": [], "light": []}


def faults_in(page: Page, *rules: str) -> list[str]:
    """What axe-core, by these of its rules or all, calls serious or critical: the rule and the elements."""
    found = Axe().run(page, options={"runOnly": rules} if rules else None).response["violations"]
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    return [f"{one['id']}: {[node['html'][:120] for node in one['nodes']]}" for one in serious]


def in_both_themes(page: Page) -> dict[str, list[str]]:
    """The themes differ in their colors alone."""
    found = {}
    for theme, rules in (("dark", ["color-contrast"]), ("light", [])):
        page.emulate_media(color_scheme=theme, reduced_motion="reduce")  # type: ignore[arg-type]
        found[theme] = faults_in(page, *rules)
    return found


def test_home_page_empty_and_at_work(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    open_page(page, service)
    assert in_both_themes(page) == NONE
    give_files(page, files)
    click_at(page, CHAIR)
    expect(page.locator("#boxes li")).to_have_count(1)
    page.locator("#options summary").click()
    page.locator("#numbers summary").click()
    page.click("#register")
    page.wait_for_selector(".run[data-verdict]")
    assert in_both_themes(page) == NONE
    for address, shown in (("/fields", ".tile canvas"), ("/docs", "h1"), ("/jobs", ".tile")):
        page.goto(service + address)
        page.wait_for_selector(shown)
        assert in_both_themes(page) == NONE, address
    page.get_by_role("button", name="Run again").click()
    expect(page.locator("#again-dialog")).to_be_visible()
    assert in_both_themes(page) == NONE
    page.evaluate("() => document.querySelector('dialog[open]').append(document.createElement('button'))")
    assert any(fault.startswith("button-name") for fault in faults_in(page)), "a rule that is broken is found"


def test_page_of_a_job(visit: Visit) -> None:
    page = visit.page
    for story in ("running", "failed", "searched", "locked"):
        page.goto(visit.server.view(story))
        if story == "running":
            expect(page.locator("#message-title")).to_have_text("Optimizing")
        else:
            page.wait_for_selector("html[data-page=ready]")
        assert in_both_themes(page) == NONE, story


FOCUSED = """() => {
  const node = document.activeElement;
  return node.id || node.className || node.dataset.layer || node.tagName;
}"""
NAMELESS = """() => [...document.querySelectorAll('button, input, select, a[href], progress, canvas')]
  .filter((node) => node.checkVisibility() && !(node.getAttribute('aria-label') || node.labels?.length
    || node.textContent.trim() || node.querySelector('img[alt]:not([alt=""])')))
  .map((node) => node.outerHTML)"""


def test_tab_visits_the_controls_in_reading_order_and_everything_has_a_name(visit: Visit) -> None:
    page = visit.open("done")
    order = []
    for _ in range(26):
        page.keyboard.press("Tab")
        order.append(str(page.evaluate(FOCUSED)))
        if order[-1] == "canvas":
            assert page.locator("#canvas").evaluate("node => getComputedStyle(node).outlineStyle") == "solid"
    wanted = ["skip", "brand", "copy-id", "canvas", "scene", "color", "up", "size", "frame-object", "play", "iteration"]
    places = [order.index(name) for name in wanted]
    assert places == sorted(places), order
    assert page.evaluate(NAMELESS) == []
    expect(page.locator("#status")).to_have_attribute("aria-live", "polite")
    expect(page.locator("html")).to_have_attribute("lang", "en")
    ids = page.evaluate("() => [...document.querySelectorAll('[id]')].map((node) => node.id)")
    assert len(ids) == len(set(ids))


@pytest.fixture
def phone(context_options: dict[str, Any]) -> None:
    context_options |= {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True}


SPILLING = """() => [...document.body.querySelectorAll('*')].filter((node) => node.checkVisibility()
  && !node.closest('.unseen, .skip') && node.getBoundingClientRect().right > 361).map((node) => node.outerHTML)"""


@pytest.mark.usefixtures("phone")
def test_nothing_overflows_on_a_phone_and_touch_turns_the_view(visit: Visit) -> None:
    for story in ("ambiguous", "searched", "failed", "locked", "done"):
        page = visit.open(story)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, story
        assert page.evaluate(SPILLING) == [], story
    assert blue(page).mean() > 0.005
    assert page.locator("#canvas").evaluate("node => getComputedStyle(node).touchAction") == "none"
