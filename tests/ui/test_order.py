"""No list and no state of a page depends on the order in which answers come."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from regnf_state.settings import Settings
from tests.ui import room
from tests.ui.conftest import Files, Visit
from tests.ui.home import CHAIR, Held, choose_scene, click_at, give_files, home, open_page

pytestmark = pytest.mark.browser
VIEWPORT = (1280, 800)
LISTS = {"fields": "**/fields?*", "jobs": "**/jobs?*", "demo": "**/demo"}


def open_in_order(page: Page, address: str, order: tuple[str, ...]) -> None:
    """Opens a page and lets the first answers to its lists come in this order."""
    held = {name: Held(page, LISTS[name]) for name in order}
    page.goto(address, wait_until="commit")
    for name in order:
        held[name].wait()
    for name in order:
        held[name].end()
    page.wait_for_selector("html[data-page=ready]")


def test_the_lists(visit: Visit, filled: str) -> None:
    page = visit.page
    for order in (("fields", "jobs", "demo"), ("jobs", "demo", "fields"), ("demo", "fields", "jobs")):
        open_in_order(page, filled, order)
        expect(page.locator("#scene-known option")).to_have_text(["none", "room.ply", "chair.glb"])
        expect(page.locator("#objects .check")).to_have_text(["chair.glb"])
        expect(page.locator("#scenes-as-objects .check")).to_have_text(["room.ply"])
    for place, titles in (("fields", ["chair.glb", "room.ply"]), ("jobs", ["chair.glb in room.ply"])):
        for order in (("fields", "jobs"), ("jobs", "fields")):
            open_in_order(page, f"{filled}/{place}", order)
            expect(page.locator(".tile h2")).to_have_count(len(titles))
            assert sorted(page.locator(".tile h2").all_inner_texts()) == titles


def test_the_title_of_a_job(visit: Visit, filled: str) -> None:
    page = visit.page
    job = page.request.get(f"{filled}/jobs", headers={"Accept": "application/json"}).json()["jobs"][0]
    for last in ("scene", "object"):
        held = Held(page, f"**/fields/{job['inputs'][last]}")
        page.goto(filled + job["links"]["view"])
        held.wait()
        expect(page.locator("#verdict-word")).to_have_text("Registered")
        held.end()
        expect(page.locator("#job-title")).to_have_text("chair.glb in room.ply")


def test_an_older_list_does_not_replace_a_newer_one(visit: Visit, filled: str) -> None:
    page = visit.page
    page.goto(f"{filled}/fields")
    expect(page.locator(".tile")).to_have_count(2)
    page.request.delete(f"{filled}/jobs/{page.request.get(f'{filled}/jobs').json()['jobs'][0]['id']}")
    held = Held(page, LISTS["fields"])
    for name in ("chair.glb", "room.ply"):
        page.get_by_role("button", name=f"Delete {name}").click()
        page.locator("dialog[open]").get_by_role("button", name="Delete").click()
        expect(page.locator("dialog[open]")).to_have_count(0)
    held.wait(2)
    held.let(1)
    expect(page.locator("#note")).to_have_text(re.compile("No fields yet"))
    held.end()
    page.wait_for_load_state("networkidle")
    expect(page.locator(".tile")).to_have_count(0)


def test_the_scene_that_was_chosen_last_is_shown(visit: Visit, filled: str) -> None:
    page = visit.page
    named = {one["label"]: one["sha256"] for one in page.request.get(f"{filled}/fields").json()["fields"]}
    first, last = named["room.ply"], named["chair.glb"]
    open_page(page, filled)
    held = Held(page, f"**/fields/{first}/mesh.glb*")
    page.select_option("#scene-known", first)
    held.wait()
    page.select_option("#scene-known", last)
    page.wait_for_selector(f"html[data-scene='{last}']")
    held.end()
    page.wait_for_load_state("networkidle")
    expect(page.locator("html")).to_have_attribute("data-scene", last)
    expect(page.locator("#tip")).to_have_text(re.compile(r"^chair\.glb: click"))
    expect(page.locator("#scene-known")).to_have_value(last)


def test_a_file_that_takes_long_does_not_replace_the_scene_that_was_chosen_meanwhile(
    visit: Visit, filled: str, tmp_path: Path
) -> None:
    page = visit.page
    other = tmp_path / "hall.ply"
    walls = room.room()
    walls.apply_scale(2.0)
    walls.export(other)
    open_page(page, filled)
    held: list[Route] = []
    page.route("**/fields", lambda route: held.append(route))
    page.set_input_files("#scene-file", other)
    expect(page.locator("#scene-state")).to_contain_text("Uploading")
    choose_scene(page)
    for route in held:
        route.continue_()
    page.unroute("**/fields")
    expect(page.locator("#scene-known option", has_text="hall.ply")).to_have_count(1, timeout=30_000)
    expect(page.locator("#scene-known option:checked")).to_have_text("room.ply")
    expect(page.locator("#scene-state")).to_have_text("room.ply")


def test_an_upload_that_ends_before_the_list_comes_is_chosen(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    held = Held(page, LISTS["fields"])
    page.goto(service)
    held.wait()
    page.set_input_files("#object-file", files[1])
    expect(page.locator("#objects input:checked")).to_have_count(1, timeout=30_000)
    held.end()
    page.wait_for_selector("html[data-page=ready]")
    expect(page.locator("#objects input:checked")).to_have_count(1)
    expect(page.locator("#missing")).to_have_text(re.compile("^Missing: a scene; a box"))


def test_a_result_of_the_scene_before_is_not_shown(visit: Visit, filled: str) -> None:
    page = visit.page
    open_page(page, filled)
    choose_scene(page)
    page.locator("#objects input").check()
    click_at(page, CHAIR)
    held = Held(page, "**/jobs/*/result")
    page.click("#register")
    held.wait()
    page.select_option("#scene-known", label="chair.glb")
    page.wait_for_selector("html[data-scene]")
    held.end()
    page.wait_for_load_state("networkidle")
    expect(page.locator(".run")).to_have_count(0)
    expect(page.locator("#results")).to_be_hidden()
    expect(page.locator("#register")).to_be_disabled()  # there is no box in the new scene


def test_the_token_is_asked_for_once_though_a_refusal_comes_after_it_was_entered(visit: Visit, files: Files) -> None:
    page = visit.page
    with home(Settings(api_tokens=frozenset({"robot:open-sesame"})), "robot") as address:
        held = Held(page, LISTS["jobs"])
        page.goto(address)
        held.wait()
        page.locator("#token").fill("open-sesame")
        page.keyboard.press("Enter")
        expect(page.locator("#token-dialog")).to_be_hidden()
        held.end()
        page.wait_for_selector("html[data-page=ready]", timeout=20_000)
        expect(page.locator("#token-dialog")).to_be_hidden()
        give_files(page, files)
        page.goto(f"{address}/fields")
        expect(page.locator(".tile")).to_have_count(2)
        page.goto("about:blank")


def test_what_is_typed_before_the_fields_are_listed_stays(visit: Visit, filled: str, files: Files) -> None:
    page = visit.page
    open_page(page, f"{filled}/library")
    held = Held(page, LISTS["fields"])
    page.click("#add")
    page.fill("#entry-name", "my chair")
    page.fill("#entry-tags", "seat")
    held.wait()
    held.end()
    expect(page.locator("#entry-field option")).to_have_count(3)
    expect(page.locator("#entry-name")).to_have_value("my chair")
    expect(page.locator("#entry-tags")).to_have_value("seat")


def test_two_clicks_open_one_dialog_and_the_way_back_shows_what_was_deleted_meanwhile(
    visit: Visit, filled: str
) -> None:
    page = visit.page
    page.goto(f"{filled}/jobs")
    held = Held(page, "**/jobs/*/request")
    page.get_by_role("button", name="Run again").dblclick()
    held.wait()
    expect(page.locator("dialog[open]")).to_have_count(1)
    expect(page.locator("#again-start")).to_be_disabled()
    held.end()
    expect(page.locator("#again-start")).to_be_enabled()
    page.get_by_role("button", name="Close").click()
    job = page.request.get(f"{filled}/jobs").json()["jobs"][0]["id"]
    page.get_by_role("link", name="Fields").click()
    page.wait_for_url("**/fields")
    page.wait_for_selector("html[data-page=ready]")
    page.request.delete(f"{filled}/jobs/{job}")
    page.go_back()
    expect(page.locator(".tile")).to_have_count(0)
