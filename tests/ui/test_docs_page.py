"""The page of the contract: navigation, search, folding, and the form that tries an address."""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from regnf_service.http.routes.examples import REGISTER_EXAMPLES
from regnf_state.settings import Settings
from tests.ui.conftest import Visit
from tests.ui.home import home, open_page

pytestmark = pytest.mark.browser
TOKEN = "open-sesame-open-sesame"


def open_docs(visit: Visit, service: str, anchor: str = "") -> Page:
    open_page(visit.page, f"{service}/docs{anchor}")
    return visit.page


def test_every_operation_is_listed_and_folded_and_the_search_leaves_what_matches(visit: Visit, service: str) -> None:
    page = open_docs(visit, service)
    links = page.locator("nav[aria-label='Addresses'] a")
    register = page.locator("nav[aria-label='Addresses'] a[href='#register']")
    expect(register).to_have_text("POST /register")
    expect(page.locator("details.operation[open]")).to_have_count(0)
    expect(page.locator("details.operation")).to_have_count(links.count())
    register.click()
    expect(page.locator("#register textarea")).to_be_visible()
    page.locator("#search").fill("cancel")
    expect(page.locator("#cancel_job")).to_be_visible()
    expect(page.locator("#put_field")).to_be_hidden()
    page.locator("#search").fill("no such address")
    expect(page.locator("#nothing")).to_be_visible()
    page.locator("#search").fill("queue_full")
    expect(page.locator("#register")).to_be_visible()
    page.goto(f"{service}/docs#QUEUE_FULL")
    expect(page.locator("#QUEUE_FULL")).to_be_in_viewport()
    assert visit.complaints == []
    assert [url for url in visit.requests if not url.startswith(service + "/")] == []


def test_an_address_is_tried(visit: Visit, service: str) -> None:
    page = open_docs(visit, service, "#get_job")
    form = page.locator("#get_job form")
    form.get_by_role("button", name="Send GET").click()
    expect(form.locator(".answer")).to_contain_text("id is required")
    form.locator("input[name=id]").fill("none")
    form.get_by_role("button", name="Send GET").click()
    expect(form.locator(".answer")).to_contain_text("JOB_NOT_FOUND")
    page.goto(f"{service}/docs#list_jobs")
    page.locator("#list_jobs form select").select_option("accepted")
    page.locator("#list_jobs").get_by_role("button", name="Send GET").click()
    for part in ("200", '"next_page_token": null'):
        expect(page.locator("#list_jobs .answer")).to_contain_text(part)
    page.goto(f"{service}/docs#register")
    shortest = next(iter(REGISTER_EXAMPLES.values()))["value"]
    assert shortest["scene"] in page.locator("#register textarea").input_value()
    page.locator("#register textarea").fill("{}")
    page.locator("#register").get_by_role("button", name="Send POST").click()
    expect(page.locator("#register .answer")).to_contain_text("INVALID_DETECTION")


def test_a_token_is_asked_for_and_sent(visit: Visit) -> None:
    settings = Settings(api_tokens=frozenset({f"lab:{TOKEN}"}))
    with home(settings, "lab") as address:
        page = visit.page
        page.goto(f"{address}/docs")
        page.wait_for_selector("html[data-page=refused]")
        expect(page.locator("#problem")).to_contain_text("access token")
        page.locator("#token").fill(TOKEN)
        page.locator("#token-form button").click()
        page.wait_for_selector("html[data-page=ready]")
        page.locator("nav[aria-label='Addresses'] a[href='#list_jobs']").click()
        page.locator("#list_jobs").get_by_role("button", name="Send GET").click()
        expect(page.locator("#list_jobs .answer")).to_contain_text("200")
        page.evaluate("sessionStorage.clear()")
        page.goto("about:blank")
