"""The page of a job that is queued or runs, has failed, was dismissed, does not exist, or is a rendering."""

from __future__ import annotations

import json

import pytest
from playwright.sync_api import Route, expect

from tests.ui.conftest import Visit
from tests.ui.stories import CANDIDATES
from tests.ui.synthetic import JOB_ID

pytestmark = pytest.mark.browser


def test_running_shows_phase_and_progress_and_cancel_ends_the_job(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.server.view("running"))
    page.wait_for_selector("#phases [aria-current=step]")
    expect(page.locator("#status")).to_have_text("Running")
    expect(page.locator("#message-title")).to_have_text("Optimizing")
    expect(page.locator("#message-text")).to_have_text("62 % done")
    expect(page.locator("#progress")).to_have_js_property("value", 0.62)
    expect(page.locator("#phases [data-state=done]")).to_have_count(3)
    page.locator("#cancel").click()
    page.wait_for_selector("text=The job was dismissed")
    expect(page.locator("#status")).to_have_text("Dismissed")
    expect(page.locator("#message-text")).to_contain_text("Press Run again to start it again.")
    expect(page.locator("#run-again")).to_be_visible()
    assert visit.complaints == []


def test_queued_tells_the_place(visit: Visit) -> None:
    visit.page.goto(visit.server.view("queued"))
    visit.page.wait_for_selector("text=3 jobs are ahead of it.")
    expect(visit.page.locator("#message-title")).to_have_text("In the queue")


@pytest.mark.parametrize("story", ["live", "polled"])
def test_follows_a_job_to_its_result(visit: Visit, story: str) -> None:
    """Where there is no stream of events, also past a connection that was lost."""
    page = visit.page
    page.goto(visit.server.view(story))
    page.wait_for_selector("text=2 jobs are ahead of it.")
    if story == "polled":
        page.context.set_offline(True)
        page.wait_for_selector("text=The service does not respond")
        visit.server.stage.advance()
        page.context.set_offline(False)
        # only the refused stream and what was lost with the connection may be complained about
        assert all(one.startswith("Failed to load resource") for one in visit.complaints), visit.complaints
        visit.complaints.clear()
    else:
        visit.server.stage.advance()
    expect(page.locator("#message-title")).to_have_text("Loading", timeout=30_000)
    visit.server.stage.advance()
    expect(page.locator("#message-title")).to_have_text("Optimizing", timeout=30_000)
    visit.server.stage.advance()
    page.wait_for_selector("#tools:not([hidden])")
    expect(page.locator("#status")).to_have_text("Registered")
    asked = [url for url in visit.requests if url.endswith("/events")]
    assert len(asked) == 1, asked
    assert [one for one in visit.complaints if "Failed to load resource" not in one or story == "live"] == []


def test_waits_for_the_files_that_follow_a_result(visit: Visit) -> None:
    answers = []

    def still_to_come(route: Route) -> None:
        answers.append(route.request.url)
        if len(answers) > 2:
            return route.continue_()
        return route.fulfill(status=409, json={"reason": "ARTIFACT_NOT_READY"}, headers={"Retry-After": "0"})

    visit.page.route("**/artifacts/trace.json", still_to_come)
    visit.open("done").wait_for_selector("#tools:not([hidden])")
    assert len(answers) == 3


def test_failure_tells_reason_and_detail_as_text_under_the_versioned_address_too(visit: Visit) -> None:
    page = visit.page
    page.goto(f"{visit.server.origin}/v1/jobs/failed/view")
    page.wait_for_selector("html[data-page=ready]")
    assert f"{visit.server.origin}/v1/jobs/failed" in visit.requests
    expect(page.locator("#status")).to_have_text("Failed")
    expect(page.locator("#message-title")).to_have_text("No surface in the detection")
    expect(page.locator("#message-text")).to_contain_text("<b>chair</b>")
    expect(page.locator("#message-text b")).to_have_count(0)
    for fact in ("NO_SURFACE_IN_DETECTION", "req-7f3a"):
        expect(page.locator("#message-facts")).to_contain_text(fact)
    expect(page.locator("#message-hint")).to_have_text("Check the box.")
    for part in ("#canvas", "#candidates", "#in-scene"):
        expect(page.locator(part)).to_be_hidden()
    assert [url for url in visit.requests if "/candidates/" in url] == []  # the document is read for the field's name
    assert visit.complaints == []


def test_unknown_job_says_so(visit: Visit) -> None:
    page = visit.open("unheard_of")
    expect(page.locator("#message-title")).to_have_text("This job does not exist")
    expect(page.locator("#message-facts")).to_contain_text("JOB_NOT_FOUND")


def test_a_result_without_pictures_says_so_and_has_its_numbers(visit: Visit) -> None:
    page = visit.open("numbers")
    expect(page.locator("#message")).to_contain_text("has no pictures")
    expect(page.locator("#tools")).to_be_hidden()
    expect(page.locator("#matrix")).to_be_visible()
    assert not [one for one in visit.requests if one.endswith(".ply")]
    assert visit.complaints == []


# a field's file that may be one of several functions


def test_each_candidate_has_its_picture_and_its_line(visit: Visit) -> None:
    page = visit.open("asked")
    expect(page.locator("#candidates")).to_be_visible()
    figures = page.locator("#candidate-list figure")
    expect(figures.locator("figcaption")).to_have_text(["Scene 1: <i>smooth</i>", "Scene 2: linear"])
    lines = [json.loads(line) for line in figures.locator("code").all_inner_texts()]
    assert lines == [one["description"] for one in CANDIDATES]
    expect(figures.locator("canvas")).to_have_count(1)
    assert figures.first.locator("canvas").get_attribute("aria-label") is not None
    expect(figures.locator("i")).to_have_count(0)
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    figures.nth(1).get_by_role("button").click()
    expect(figures.nth(1).get_by_role("button")).to_have_text("Copied")
    assert json.loads(page.evaluate("navigator.clipboard.readText()")) == CANDIDATES[1]["description"]
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert visit.complaints == []
    page.route("**/candidates/1.png", lambda route: route.fulfill(status=404, json={"reason": "NONE"}))
    visit.open("asked")  # a picture that is gone leaves the line
    expect(figures.locator("code")).to_have_count(2)
    expect(figures.locator("canvas")).to_have_count(0)


# the object in the scene: a rendering


def test_the_picture_is_made_once_somebody_asks(visit: Visit) -> None:
    page = visit.open("done")
    expect(page.locator("#in-scene")).to_be_visible()
    assert [url for url in visit.requests if url.endswith("/render")] == []
    note, button = page.locator("#in-scene-note"), page.locator("#render-in-scene")
    refusal = {"reason": "QUEUE_FULL", "detail": "The queue is <b>full</b>.", "status": 422}
    page.route("**/render", lambda route: route.fulfill(status=422, json=refusal))
    button.click()
    expect(note).to_have_text("The queue is <b>full</b>.")
    expect(button).to_be_enabled()
    page.unroute("**/render")
    with page.expect_request("**/render") as asked:
        button.click()
    request = json.loads(asked.value.post_data or "")
    (edit,) = request["edits"]
    assert (edit["kind"], edit["job"]) == ("substitution", JOB_ID)
    assert (request["scene"], request["outputs"]) == ("a3" * 32, ["strip"])
    expect(page.locator("#in-scene-picture canvas")).to_have_count(1)
    expect(button).to_be_hidden()
    expect(note.locator("a")).to_have_attribute("href", "/jobs/rendered/view")
    visit.open("bare")  # a pose that may be used
    expect(button).to_be_visible()


def test_a_rendering_that_fails_says_why(visit: Visit) -> None:
    page = visit.open("ambiguous")
    failed = {
        "id": "x",
        "kind": "render",
        "status": "failed",
        "error": {"detail": "the camera at (1, 2) is inside solid matter"},
    }
    page.route("**/render", lambda route: route.fulfill(status=200, json=failed))
    page.locator("#render-in-scene").click()
    expect(page.locator("#in-scene-note")).to_have_text("the camera at (1, 2) is inside solid matter.")


def test_the_page_of_a_rendering_shows_its_strip(visit: Visit) -> None:
    page = visit.open("rendered")
    expect(page.locator("#in-scene-picture canvas")).to_have_count(1)
    expect(page.locator("#files")).to_contain_text("before-after.png")
    for part in ("#render-in-scene", "#transform"):
        expect(page.locator(part)).to_be_hidden()
    assert visit.complaints == []
