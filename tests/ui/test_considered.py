"""The poses that were judged, on the page of a job: each can be looked at, with what speaks against it."""

from __future__ import annotations

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.ui.conftest import Visit
from tests.ui.pixels import canvas_pixels
from tests.ui.test_accessibility import NONE, in_both_themes

pytestmark = pytest.mark.browser


def red_share(page: Page) -> float:
    """The share of the view that is marked red."""
    red, green, blue = np.moveaxis(canvas_pixels(page), -1, 0)
    return float(((red - green > 90) & (red - blue > 90)).mean())


def test_a_rejected_pose_is_shown_with_what_speaks_against_it(visit: Visit) -> None:
    page = visit.open("judged")
    poses = page.locator("#considered-list label")
    expect(poses).to_have_count(2)
    expect(poses.nth(0)).to_contain_text("The surfaces agree.")
    expect(poses.nth(1)).to_contain_text("<b>FREE_SPACE_VIOLATED</b>")
    before = page.locator("#matrix").inner_text()
    red = red_share(page)
    poses.nth(1).locator("input").check()
    expect(page.locator("#considered-facts")).to_contain_text("40.0 %")
    expect(page.locator("#transform-note")).to_have_text("A candidate pose")
    expect(page.locator("#considered-key")).to_be_visible()
    assert page.locator("#matrix").inner_text() != before
    assert red_share(page) > red + 0.002
    assert in_both_themes(page) == NONE
    page.emulate_media(color_scheme="light")
    page.locator("#iteration").press("End")
    page.locator("#iteration").press("Home")
    expect(page.locator("#considered-list input:checked")).to_have_count(0)
    assert red_share(page) == pytest.approx(red, abs=0.001)
    assert visit.complaints == []


def test_a_result_without_them_has_no_such_list(visit: Visit) -> None:
    page = visit.open("done")
    expect(page.locator("#considered")).to_be_hidden()
