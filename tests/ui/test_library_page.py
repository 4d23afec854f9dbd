"""The library's page over the real application: an object is added, changed, chosen for a search, and taken out."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.home import NETWORK, open_page
from tests.ui.test_accessibility import NONE, in_both_themes

pytestmark = pytest.mark.browser
VIEWPORT = (1280, 800)


def test_an_object_from_its_file_to_the_library_and_out_again(
    visit: Visit, service: str, files: tuple[Path, Path, Path]
) -> None:
    page = visit.page
    open_page(page, f"{service}/library")
    expect(page.locator("#note")).to_have_text(re.compile("Nothing in the library yet"))
    page.get_by_role("button", name="Add objects").click()
    page.set_input_files("#entry-file", files[1])
    expect(page.locator("#entry-name")).to_have_value("chair")
    page.fill("#entry-tags", "seat, oak")
    page.select_option("#entry-unit", "m")
    page.select_option("#entry-symmetry", "turns")
    page.fill("#entry-order", "4")
    assert in_both_themes(page) == NONE
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".tile h2")).to_have_text("chair")
    expect(page.locator(".tile")).to_contain_text("4 turns about 0, 0, 1 (as said)")
    assert in_both_themes(page) == NONE
    page.get_by_role("button", name="Edit chair").click()
    expect(page.locator("#entry-tags")).to_have_value("oak, seat")
    page.fill("#entry-name", "a/b")
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#entry-state .bad")).to_contain_text("1 to 64 characters")
    page.fill("#entry-name", "armchair")
    page.select_option("#entry-symmetry", "detected")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".tile h2")).to_have_text("armchair")
    expect(page.locator(".tile")).not_to_contain_text("as said")
    page.get_by_role("button", name="Show the tag seat").click()
    expect(page.locator("#tag")).to_have_value("seat")
    page.locator("#search").fill("table")
    expect(page.locator(".tile")).to_have_count(0)
    page.locator("#search").fill("")
    page.get_by_role("link", name="Search for this").click()
    page.wait_for_selector("html[data-page=ready]")
    expect(page.locator("#objects label", has_text="armchair").locator("input")).to_be_checked()
    page.goto(f"{service}/?tag=seat")
    expect(page.locator("#objects input:checked")).to_have_count(1)
    page.goto(f"{service}/fields")
    page.get_by_role("button", name="Delete armchair").click()
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    expect(page.locator("dialog[open]")).to_contain_text("library")  # and stays to say so
    page.get_by_role("button", name="Close").click()
    page.goto(f"{service}/library")
    page.get_by_role("button", name="Remove armchair").click()
    assert in_both_themes(page) == NONE
    page.locator("dialog[open]").get_by_role("button", name="Remove").click()
    expect(page.locator(".tile")).to_have_count(0)
    page.goto(f"{service}/fields")
    page.get_by_role("link", name="Add to library").click()
    expect(page.locator("#entry-name")).to_have_value("chair")
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
    assert [url for url in visit.requests if not url.startswith((service + "/", "blob:"))] == []
