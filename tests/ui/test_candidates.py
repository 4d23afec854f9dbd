"""The page of a job whose field's file may be one of several functions."""

from __future__ import annotations

import json
from pathlib import Path

from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.stories import CANDIDATES


def test_each_candidate_has_its_picture_and_its_line(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("asked")
    expect(page.locator("#candidates")).to_be_visible()
    figures = page.locator("#candidate-list figure")
    expect(figures.locator("figcaption")).to_have_text(["Scene 1: <i>smooth</i>", "Scene 2: linear"])
    lines = [json.loads(line) for line in figures.locator("code").all_inner_texts()]
    assert lines == [one["description"] for one in CANDIDATES]
    expect(figures.locator("canvas")).to_have_count(1)
    assert figures.first.locator("canvas").get_attribute("aria-label") is not None
    assert figures.locator("i").count() == 0
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    figures.nth(1).get_by_role("button").click()
    expect(figures.nth(1).get_by_role("button")).to_have_text("Copied")
    assert json.loads(page.evaluate("navigator.clipboard.readText()")) == CANDIDATES[1]["description"]
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.screenshot(path=tmp_path / "page.png")
    assert visit.complaints == []


def test_other_failures_have_no_candidates(visit: Visit) -> None:
    page = visit.open("failed")
    expect(page.locator("#candidates")).to_be_hidden()
    assert [url for url in visit.requests if "/candidates/" in url] == []  # the document is read for the field's name


def test_a_picture_that_is_gone_leaves_the_line(visit: Visit) -> None:
    visit.page.route("**/candidates/1.png", lambda route: route.fulfill(status=404, json={"reason": "NONE"}))
    page = visit.open("asked")
    expect(page.locator("#candidate-list code")).to_have_count(2)
    expect(page.locator("#candidate-list canvas")).to_have_count(0)
