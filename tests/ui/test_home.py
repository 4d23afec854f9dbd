"""The home page over the real application: files, a click, a box, a registration, lists. The worker is pretended."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from tests.ui import room
from tests.ui.conftest import Files, Visit
from tests.ui.home import CHAIR, NETWORK, box_of, choose_scene, click_at, give_files, open_page, register, upload

pytestmark = pytest.mark.browser
VIEWPORT = (1280, 800)
TURN = "Turn about the up axis, degrees"


def numbers_of(page: Page) -> dict[str, float]:
    inputs = page.locator("#box-numbers input")
    names = [str(inputs.nth(i).get_attribute("aria-label")) for i in range(inputs.count())]
    return {name: float(inputs.nth(i).input_value()) for i, name in enumerate(names)}


def test_from_files_to_a_registered_chair(visit: Visit, service: str, files: Files, tmp_path: Path) -> None:
    page = visit.page
    (tmp_path / "empty.ply").write_bytes(b"hello, this is no field")
    open_page(page, service)
    page.set_input_files("#scene-file", tmp_path / "empty.ply")
    expect(page.locator("#scene-state .bad")).to_contain_text("empty.ply: ")  # refused, and why
    give_files(page, files)
    click_at(page, CHAIR)
    expect(page.locator("#boxes li")).to_have_count(1)
    found = numbers_of(page)
    # the chair is 0.57 by 0.565 by 1 m, turned by 0.6 radians
    assert found["Center x"] == pytest.approx(room.CHAIR_AT[0], abs=0.06)
    assert found["Center y"] == pytest.approx(room.CHAIR_AT[1], abs=0.06)
    assert found["Size z"] == pytest.approx(1.0, abs=0.12)
    assert max(found["Size x"], found["Size y"]) < 0.72
    assert (found[TURN] - np.degrees(room.CHAIR_TURN) + 45) % 90 == pytest.approx(45, abs=5)
    page.click("#register")
    expect(page.locator(".run strong")).to_have_text("Box 1, registered: chair.glb")
    page.click(".run a")
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    page.goto(f"{service}/jobs")
    expect(page.locator(".tile h2")).to_have_text("chair.glb in room.ply")
    page.locator("#search").fill("table")
    expect(page.locator(".tile")).to_have_count(0)
    page.locator("#search").fill("")
    page.get_by_role("button", name="Delete").click()
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    expect(page.locator("#note")).to_have_text(re.compile("No jobs yet"))
    page.goto(f"{service}/fields")
    expect(page.locator(".tile h2")).to_have_count(2, timeout=20_000)
    assert sorted(page.locator(".tile h2").all_inner_texts()) == ["chair.glb", "room.ply"]  # they were sent at once
    page.locator(".tile", has_text="room.ply").get_by_role("link", name="Use as scene").click()
    page.wait_for_selector("html[data-scene]")
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
    assert [url for url in visit.requests if not url.startswith((service + "/", "blob:"))] == []


def test_boxes_are_edited_by_mouse_keys_and_numbers(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    upload(service, files[:1])
    open_page(page, service)
    choose_scene(page)
    click_at(page, CHAIR)
    expect(page.locator("#boxes li")).to_have_count(1)
    before = numbers_of(page)
    page.locator(".handle.turn").focus()
    page.keyboard.press("ArrowRight")
    assert numbers_of(page)[TURN] == pytest.approx(before[TURN] + 5, abs=0.2)
    top = box_of(page, ".handle[aria-label='Top']")
    page.mouse.move(top["x"] + top["width"] / 2, top["y"] + top["height"] / 2)
    page.mouse.down()
    page.mouse.move(top["x"] + top["width"] / 2, top["y"] - 30, steps=3)
    page.mouse.up()
    after = numbers_of(page)
    assert after["Size z"] > before["Size z"] + 0.1
    low = before["Center z"] - before["Size z"] / 2
    assert after["Center z"] - after["Size z"] / 2 == pytest.approx(low, abs=1e-3)  # the bottom stays
    page.locator("#numbers summary").click()
    page.locator("input[aria-label='Size x']").fill("2")
    page.keyboard.press("Enter")
    expect(page.locator("#boxes button").first).to_have_text(re.compile("Box 1: 2 × "))
    page.click("#add-box")
    click_at(page, (0.63, 0.67))  # the lamp on the table
    expect(page.locator("#boxes li")).to_have_count(2)
    page.get_by_role("button", name="Remove box 1").click()
    expect(page.locator("#boxes li")).to_have_count(1)


def test_run_again_keeps_what_the_form_does_not_show_and_two_runs_are_compared(
    visit: Visit, service: str, files: Files
) -> None:
    """The comparison opens at its top, in the words of a job's page, however small the window."""
    page = visit.page
    turned = [[0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    options = {"robust": {"rotations": 77}}
    register(service, upload(service, files[:2]), options=options, ground_truth={"T_object_scene": turned})
    page.goto(f"{service}/jobs")
    page.get_by_role("button", name="Run again").click()
    page.get_by_label("Seed").fill("7")
    page.get_by_label("Accept at level").select_option('"strict"')
    page.click("#again-start")
    page.wait_for_url("**/view")
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    again = page.request.get(page.url.removesuffix("/view") + "/request").json()
    robust = again["options"]["robust"]
    assert (robust["rotations"], robust["acceptance"], again["seed"]) == (77, "strict", 7)
    assert again["ground_truth"] == {"T_object_scene": turned}
    page.set_viewport_size({"width": 600, "height": 320})
    page.goto(f"{service}/jobs")
    expect(page.locator(".tile .word")).to_have_text(["Registered", "Registered"])
    for part in ("seed 7", "probability 97.0 %, default"):
        expect(page.locator(".tile").first).to_contain_text(part)
    expect(page.locator("#compare")).to_be_disabled()
    marks = page.get_by_role("checkbox", name=re.compile("^Compare"))
    expect(marks).to_have_count(2)
    for mark in marks.all():
        mark.check()
    page.click("#compare")
    for part in ("turned by 0.00°", "Residual RMS"):
        expect(page.locator("#comparison")).to_contain_text(part)
    expect(page.locator("#compare-title")).to_be_focused()
    expect(page.locator("#compare-title")).to_be_in_viewport()
    page.set_viewport_size({"width": VIEWPORT[0], "height": VIEWPORT[1]})
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []


@pytest.mark.parametrize("busy_answers", [3, 1000])
def test_the_page_asks_again_while_the_store_is_busy_and_says_that_it_stays_so(
    visit: Visit, service: str, busy_answers: int
) -> None:
    page = visit.page
    asked: list[str] = []
    problem = '{"reason": "STORAGE_UNAVAILABLE", "detail": "The job store does not respond. Retry later."}'

    def busy(route: Route) -> None:
        asked.append(route.request.url)
        if len(asked) > busy_answers:
            return route.continue_()
        return route.fulfill(status=503, headers={"Retry-After": "0"}, body=problem)

    page.route("**/fields?*", busy)
    open_page(page, service)
    if busy_answers == 3:
        assert len(asked) > 3
        expect(page.locator("#tip")).to_be_hidden()
    else:
        expect(page.locator("#tip")).to_contain_text("The job store does not respond.")
