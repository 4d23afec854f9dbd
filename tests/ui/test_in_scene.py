"""The object in the scene: a rendering that is asked for from a result's page, and the page of a rendering."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.synthetic import JOB_ID

pytestmark = pytest.mark.browser


def test_the_picture_is_made_once_somebody_asks(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("done")
    expect(page.locator("#in-scene")).to_be_visible()
    assert [url for url in visit.requests if url.endswith("/render")] == []
    with page.expect_request("**/render") as asked:
        page.locator("#render-in-scene").click()
    request = json.loads(asked.value.post_data or "")
    (edit,) = request["edits"]
    assert (edit["kind"], edit["job"]) == ("substitution", JOB_ID)
    assert (request["scene"], request["outputs"]) == ("a3" * 32, ["strip"])
    expect(page.locator("#in-scene-picture canvas")).to_have_count(1)
    expect(page.locator("#render-in-scene")).to_be_hidden()
    expect(page.locator("#in-scene-note a")).to_have_attribute("href", "/jobs/rendered/view")
    page.locator("#in-scene").screenshot(path=tmp_path / "card.png")
    assert visit.complaints == []


def test_a_refusal_is_shown_and_can_be_tried_again(visit: Visit) -> None:
    page = visit.open("done")
    problem = {"reason": "QUEUE_FULL", "detail": "The queue is <b>full</b>.", "status": 422}
    page.route("**/render", lambda route: route.fulfill(status=422, json=problem))
    page.locator("#render-in-scene").click()
    expect(page.locator("#in-scene-note")).to_have_text("The queue is <b>full</b>.")
    expect(page.locator("#render-in-scene")).to_be_enabled()
    page.unroute("**/render")
    page.locator("#render-in-scene").click()
    expect(page.locator("#in-scene-picture canvas")).to_have_count(1)


def test_a_rendering_that_fails_says_why(visit: Visit) -> None:
    page = visit.open("done")
    failed = {"id": "x", "kind": "render", "status": "failed", "error": {"detail": "the camera at (1, 2) is in matter"}}
    page.route("**/render", lambda route: route.fulfill(status=200, json=failed))
    page.locator("#render-in-scene").click()
    expect(page.locator("#in-scene-note")).to_have_text("the camera at (1, 2) is in matter.")


@pytest.mark.parametrize("story", ["bare", "ambiguous", "failed"])
def test_only_poses_that_may_be_used_are_offered(visit: Visit, story: str) -> None:
    page = visit.open(story)
    if story == "failed":
        expect(page.locator("#in-scene")).to_be_hidden()
    else:
        expect(page.locator("#render-in-scene")).to_be_visible()


def test_the_page_of_a_rendering_shows_its_strip(visit: Visit) -> None:
    page = visit.open("rendered")
    expect(page.locator("#in-scene-picture canvas")).to_have_count(1)
    expect(page.locator("#render-in-scene")).to_be_hidden()
    expect(page.locator("#files")).to_contain_text("before-after.png")
    expect(page.locator("#transform")).to_be_hidden()
    assert visit.complaints == []
