"""The page while a job is queued or runs, and when it has failed, was dismissed or does not exist."""

from __future__ import annotations

import pytest
from playwright.sync_api import Route, expect

from tests.ui.conftest import Visit

pytestmark = pytest.mark.browser


def test_running_shows_phase_and_progress(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.server.view("running"))
    page.wait_for_selector("#phases [aria-current=step]")
    expect(page.locator("#status")).to_have_text("Running")
    expect(page.locator("#message-title")).to_have_text("Optimizing")
    expect(page.locator("#message-text")).to_have_text("62 % done")
    expect(page.locator("#progress")).to_have_js_property("value", 0.62)
    expect(page.locator("#phases [data-state=done]")).to_have_count(3)
    assert visit.complaints == []


def test_queued_tells_the_place(visit: Visit) -> None:
    visit.page.goto(visit.server.view("queued"))
    visit.page.wait_for_selector("text=3 jobs are before it.")
    expect(visit.page.locator("#message-title")).to_have_text("In the queue")


@pytest.mark.parametrize("story", ["live", "polled"])
def test_follows_a_job_to_its_result(visit: Visit, story: str) -> None:
    page = visit.page
    page.goto(visit.server.view(story))
    page.wait_for_selector("text=2 jobs are before it.")
    for phase in ("Loading", "Optimizing"):
        visit.server.stage.advance()
        expect(page.locator("#message-title")).to_have_text(phase, timeout=30_000)
    visit.server.stage.advance()
    page.wait_for_selector("#tools:not([hidden])")
    expect(page.locator("#status")).to_have_text("Registered")
    asked = [url for url in visit.requests if url.endswith("/events")]
    assert len(asked) == 1, asked
    # Only the refused stream may be complained about, and only where it is refused.
    assert len(visit.complaints) == (1 if story == "polled" else 0), visit.complaints


def test_waits_for_the_files_that_follow_a_result(visit: Visit) -> None:
    answers = []

    def still_to_come(route: Route) -> None:
        answers.append(route.request.url)
        if len(answers) > 2:
            return route.continue_()
        return route.fulfill(status=409, json={"reason": "ARTIFACT_NOT_READY"}, headers={"Retry-After": "0"})

    visit.page.route("**/artifacts/trace.json", still_to_come)
    page = visit.open("done")
    page.wait_for_selector("#tools:not([hidden])")
    assert len(answers) == 3


def test_cancel_ends_the_job(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.server.view("running"))
    page.locator("#cancel").click()
    page.wait_for_selector("text=The job was dismissed")
    expect(page.locator("#status")).to_have_text("Dismissed")
    expect(page.locator("#message-text")).to_contain_text("Run again starts it anew.")
    expect(page.locator("#run-again")).to_be_visible()


def test_failure_tells_reason_and_detail_as_text(visit: Visit) -> None:
    page = visit.open("failed")
    expect(page.locator("#status")).to_have_text("Failed")
    expect(page.locator("#message-title")).to_have_text("No surface in the detection")
    expect(page.locator("#message-text")).to_contain_text("<b>chair</b>")
    expect(page.locator("#message-text b")).to_have_count(0)
    expect(page.locator("#message-facts")).to_contain_text("NO_SURFACE_IN_DETECTION")
    expect(page.locator("#message-facts")).to_contain_text("req-7f3a")
    expect(page.locator("#message-hint")).to_have_text("Check the box.")
    expect(page.locator("#canvas")).to_be_hidden()
    assert visit.complaints == []


def test_unknown_job_says_so(visit: Visit) -> None:
    page = visit.open("unheard_of")
    expect(page.locator("#message-title")).to_have_text("There is no such job")
    expect(page.locator("#message-facts")).to_contain_text("JOB_NOT_FOUND")


def test_versioned_address_works_too(visit: Visit) -> None:
    page = visit.page
    page.goto(f"{visit.server.origin}/v1/jobs/failed/view")
    page.wait_for_selector("html[data-page=ready]")
    expect(page.locator("#status")).to_have_text("Failed")
    assert f"{visit.server.origin}/v1/jobs/failed" in visit.requests


def test_lost_connection_is_told_and_mended(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.server.view("polled"))
    page.wait_for_selector("text=2 jobs are before it.")
    page.context.set_offline(True)
    page.wait_for_selector("text=The service does not answer")
    visit.server.stage.advance()
    page.context.set_offline(False)
    expect(page.locator("#message-title")).to_have_text("Loading", timeout=30_000)


def test_a_result_without_pictures_says_so_and_has_its_numbers(visit: Visit) -> None:
    page = visit.open("numbers")
    expect(page.locator("#message")).to_contain_text("without pictures")
    expect(page.locator("#tools")).to_be_hidden()
    expect(page.locator("#matrix")).to_be_visible()
    assert not [one for one in visit.requests if one.endswith(".ply")]
    assert visit.complaints == []
