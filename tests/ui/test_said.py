"""What the pages of the service say: names, finds, sizes, errors, questions before a deletion, the library."""

from __future__ import annotations

import re
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Route, expect

from regnf_core.options import RobustOptions
from tests.ui.conftest import Files, Visit
from tests.ui.home import CHAIR, NETWORK, box_of, choose_scene, click_at, give_files, open_page, register, upload
from tests.ui.test_access import NONE, in_both_themes

pytestmark = pytest.mark.browser
VIEWPORT = (1280, 800)
FAULTS = {
    "reason": "INVALID_OPTIONS", "detail": "An option is wrong.", "hint": "See the table.",
    "errors": [
        {"pointer": "/options/robust", "detail": "min_scale 2 is larger than max_scale 1"},
        {"pointer": "/seed", "detail": "must not be negative"},
    ],
}  # fmt: skip


def test_the_card_of_a_search_says_what_was_found_where_and_its_page_leads_on(
    visit: Visit, service: str, files: Files
) -> None:
    page = visit.page
    fields = upload(service, files)
    job = register(service, fields)
    named = dict(zip(fields, ("room.ply", "chair.glb", "stool.glb"), strict=True))
    title = f"{named[job['object_found']]} in room.ply"
    page.goto(f"{service}/jobs")
    expect(page.locator(".tile h2")).to_have_text(title)
    expect(page.locator(".tile .word")).to_have_text("Registered")
    expect(page.locator(".tile")).to_contain_text("the most probable of 2 objects")
    box = re.compile(r"box [\d.]+ × [\d.]+ × [\d.]+ at [−\d.]+, [−\d.]+, [−\d.]+")
    expect(page.locator(".tile")).to_contain_text(box)
    page.get_by_role("link", name="Open").click()
    expect(page.locator("#job-title")).to_have_text(title)
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    expect(page.locator("header nav a")).to_have_text(["Register", "Library", "Jobs", "Fields", "API"])
    page.get_by_role("button", name="Run again").click()
    expect(page.locator("#again-start")).to_be_enabled()
    page.get_by_role("button", name="Close").click()
    page.get_by_role("button", name="Delete").click()
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    page.wait_for_url("**/jobs")
    expect(page.locator("#note")).to_contain_text("No jobs yet")


def test_every_member_of_a_problem_is_shown(visit: Visit, filled: str) -> None:
    page = visit.page
    open_page(page, filled)
    choose_scene(page)
    page.locator("#objects input").check()
    click_at(page, CHAIR)
    page.route("**/register", lambda route: route.fulfill(status=422, json=FAULTS))
    page.click("#register")
    faults = "options.robust: min_scale 2 is larger than max_scale 1. seed: must not be negative."
    expect(page.locator(".run .bad")).to_have_text(f"An option is wrong. {faults} See the table.")
    page.unroute("**/register")
    page.goto(f"{filled}/jobs")
    page.get_by_role("button", name="Run again").click()
    page.get_by_label(re.compile("^Min. scale")).fill("2")
    page.get_by_label("Max. scale").fill("1")
    page.click("#again-start")
    expect(page.locator("dialog[open] .bad")).to_contain_text("min_scale 2 is larger than max_scale 1")


def test_a_deletion_asks_and_the_focus_goes_to_what_is_there_then(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    register(service, upload(service, files))
    page.goto(f"{service}/jobs")
    page.get_by_role("button", name="Delete").click()
    expect(page.locator("dialog[open]")).to_contain_text("in room.ply”?")
    expect(page.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("dialog")).to_have_count(2)  # those of the page itself
    expect(page.get_by_role("button", name="Delete")).to_be_focused()
    expect(page.locator(".tile")).to_have_count(1)
    page.keyboard.press("Enter")
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    expect(page.locator("#list")).to_be_focused()  # nothing is left in it
    page.goto(f"{service}/fields")
    page.get_by_role("button", name="Delete chair.glb").click()
    page.locator("dialog[open]").get_by_role("button", name="Delete").click()
    expect(page.locator(".tile h2").nth(1)).to_be_focused()


def test_a_field_is_called_what_its_file_is_called_now_and_has_the_size_of_its_surface(
    visit: Visit, service: str, files: Files, tmp_path: Path
) -> None:
    page = visit.page
    upload = {"file": {"name": "x", "mimeType": "application/octet-stream", "buffer": files[2].read_bytes()}}
    page.request.post(f"{service}/fields", multipart={"description": '{"as": "object"}', **upload})
    mine = tmp_path / "my stool.glb"
    mine.write_bytes(files[2].read_bytes())
    open_page(page, service)
    page.set_input_files("#object-file", mine)
    expect(page.locator("#objects")).to_contain_text("my stool.glb")
    expect(page.locator("#objects input:checked")).to_have_count(1)
    page.goto(f"{service}/fields")
    expect(page.locator(".tile h2")).to_have_text("my stool.glb")
    expect(page.locator(".tile")).to_contain_text("0.4 × 0.3 × 0.5")
    page.get_by_role("link", name="Add to library").click()
    expect(page.locator("#entry-name")).to_have_value("my stool")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".tile")).to_contain_text("0.4 × 0.3 × 0.5")


def test_rooms_are_no_candidates_unless_a_person_says_so(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    upload(service, files)
    open_page(page, service)
    page.locator("#all-objects").check()
    expect(page.locator("label:has(input:checked)")).to_have_count(3)
    chosen = ["All objects: find out which one it is", "chair.glb", "stool.glb"]
    assert sorted(page.locator("label:has(input:checked)").all_inner_texts()) == chosen
    page.goto(f"{service}/fields")
    page.get_by_label("What stool.glb is").select_option("scene")
    open_page(page, service)
    expect(page.locator("#objects .check")).to_have_text(["chair.glb"])
    groups = page.locator("#scene-known optgroup")
    assert [groups.nth(i).get_attribute("label") for i in range(groups.count())] == ["Scenes", "Objects"]


def test_several_files_become_entries_and_leaving_meanwhile_is_asked_about(
    visit: Visit, service: str, files: Files
) -> None:
    page = visit.page
    asks = "() => !window.dispatchEvent(new Event('beforeunload', { cancelable: true }))"
    open_page(page, f"{service}/library")
    page.click("#add")
    page.set_input_files("#entry-file", list(files[1:]))
    page.fill("#entry-tags", "seat")
    held: list[Route] = []
    page.route("**/fields", lambda route: held.append(route))
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#entry-state")).to_contain_text(re.compile("Uploading.*Uploading"))
    assert page.evaluate(asks)
    expect(page.locator("#entry-close")).to_be_disabled()
    page.keyboard.press("Escape")
    expect(page.locator("#entry-dialog")).to_be_visible()
    for route in held:
        route.continue_()
    expect(page.locator("#entry-dialog")).to_be_hidden(timeout=20_000)
    expect(page.locator(".tile h2")).to_have_count(2)  # the list is asked for anew once the dialog is closed
    assert sorted(page.locator(".tile h2").all_inner_texts()) == ["chair", "stool"]
    expect(page.get_by_role("button", name="Show the tag seat")).to_have_count(2)
    assert not page.evaluate(asks)


def test_an_import_that_waits_says_so(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    waiting = {"sha256": "0" * 64, "state": "validating", "queue_position": 3, "bytes": 1, "description": {}}
    open_page(page, service)
    page.route(re.compile(r"/fields/[0-9a-f]{64}"), lambda route: route.fulfill(json=waiting))
    page.set_input_files("#scene-file", files[0])
    for place in ("#scene-state", "#welcome-state"):
        expect(page.locator(place)).to_contain_text("Waiting for a worker: 2 before it")
    expect(page.locator("#welcome .steps")).to_be_hidden()


def test_the_result_lies_over_the_scene_and_nothing_scrolls_but_the_panel(
    visit: Visit, service: str, files: Files
) -> None:
    page = visit.page
    open_page(page, service)
    page.locator("#options > summary").click()
    page.locator("#options-form details summary").click()
    rows = page.locator("#options-form input[placeholder]")
    expect(rows).not_to_have_count(0)
    shown = [str(one.get_attribute("placeholder")).replace(",", "") for one in rows.all()]
    defaults = [one.default for one in fields_of(RobustOptions) if not isinstance(one.default, bool | str)]
    assert sorted(shown) == sorted("not given" if usual is None else f"{usual:g}" for usual in defaults)
    give_files(page, files[:2])
    click_at(page, CHAIR)
    page.click("#register")
    page.wait_for_selector(".run[data-verdict]")
    stage, results = box_of(page, "#stage"), box_of(page, "#results")
    assert results["x"] >= stage["x"]
    assert results["x"] + results["width"] <= stage["x"] + stage["width"]
    assert results["y"] + results["height"] <= 800
    assert page.evaluate("document.scrollingElement.scrollHeight") <= 800
    assert in_both_themes(page) == NONE


CROWDED = """() => {
  const seen = [...document.querySelectorAll('button, .button, .pick, select')]
    .filter((node) => node.checkVisibility() && !node.closest('.handles'));
  const boxes = seen.map((node) => [node, node.getBoundingClientRect()]);
  const touching = [];
  for (const [a, p] of boxes) for (const [b, q] of boxes) {
    const apart = Math.max(q.left - p.right, p.left - q.right, q.top - p.bottom, p.top - q.bottom);
    if (a !== b && a.parentElement === b.parentElement && apart < 3) touching.push([a.outerHTML, b.outerHTML, apart]);
  }
  const pencil = document.createElement('canvas').getContext('2d');
  const cut = seen.filter((node) => node.tagName === 'SELECT' && node.selectedOptions.length).filter((node) => {
    pencil.font = getComputedStyle(node).font;
    return pencil.measureText(node.selectedOptions[0].text).width + 28 > node.getBoundingClientRect().width;
  }).map((node) => node.selectedOptions[0].text);
  return { touching, cut, wide: document.documentElement.scrollWidth - innerWidth };
}"""


def test_buttons_have_gaps_and_no_choice_is_cut(visit: Visit, filled: str) -> None:
    page = visit.page
    open_page(page, filled)
    choose_scene(page)
    page.locator("#objects input").check()
    click_at(page, CHAIR)
    page.click("#register")
    page.wait_for_selector(".run[data-verdict]")
    page.locator("#options > summary").click()

    def look(place: str) -> None:
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 800})
            seen = page.evaluate(CROWDED)
            assert seen.pop("wide") <= 0, (place, width)
            assert seen == {"touching": [], "cut": []}, (place, width)

    look("home")
    for place in ("fields", "library", "docs", "jobs"):
        open_page(page, f"{filled}/{place}")
        expect(page.locator("header nav a")).to_have_count(5)
        look(place)
    page.get_by_role("button", name="Run again").first.click()
    expect(page.locator("#again-start")).to_be_enabled()
    look("again")
    page.set_viewport_size({"width": 1280, "height": 800})


PAPER = """async (onPaper) => {
  const { canvasOf } = await import('/static/js/pictures.js');
  const drawn = new OffscreenCanvas(60, 20);
  const pencil = drawn.getContext('2d');
  pencil.fillStyle = 'rgb(248 248 247)';
  pencil.fillRect(0, 0, 60, 20);
  pencil.fillStyle = 'rgb(200 205 210)';
  pencil.fillRect(5, 5, 5, 5);
  const canvas = await canvasOf(await drawn.convertToBlob(), 'a thing', null, onPaper);
  const at = (x, y) => [...canvas.getContext('2d').getImageData(x, y, 1, 1).data];
  return [at(1, 1)[3], at(7, 7)];
}"""


def test_the_paper_of_a_picture_is_left_out(visit: Visit, service: str) -> None:
    """White paper would be a white box on a dark page; a rendered picture stays whole."""
    visit.page.goto(f"{service}/fields")
    for on_paper, alpha in ((True, 0), (False, 255)):
        assert visit.page.evaluate(PAPER, on_paper) == [alpha, [200, 205, 210, 255]]


@pytest.fixture
def phone(context_options: dict[str, Any]) -> None:
    context_options |= {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


@pytest.mark.usefixtures("phone")
def test_handles_leave_the_thing_in_sight_on_a_phone(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    open_page(page, service)
    give_files(page, files[:2])
    click_at(page, CHAIR)
    expect(page.locator("#boxes li")).to_have_count(1)
    view = box_of(page)
    at = [view["x"] + CHAIR[0] * view["width"], view["y"] + CHAIR[1] * view["height"]]
    assert page.evaluate("([x, y]) => document.elementFromPoint(x, y).id", at) == "canvas"
    boxes = [one.bounding_box() for one in page.locator(".handle:visible").all()]
    assert len(boxes) >= 7
    centers = [(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2) for box in boxes if box is not None]
    near = [(a, b) for i, a in enumerate(centers) for b in centers[:i] if abs(a[0] - b[0]) + abs(a[1] - b[1]) < 24]
    assert near == []


# the library


def test_an_object_from_its_file_to_the_library_and_out_again(visit: Visit, service: str, files: Files) -> None:
    page = visit.page
    open_page(page, f"{service}/library")
    expect(page.locator("#note")).to_have_text(re.compile("The library is empty"))
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
    expect(page.locator(".tile")).to_contain_text("4 rotations about 0, 0, 1 (as given)")
    page.get_by_role("button", name="Edit chair").click()
    expect(page.locator("#entry-tags")).to_have_value("oak, seat")
    page.fill("#entry-name", "a/b")
    page.get_by_role("button", name="Save").click()
    expect(page.locator("#entry-state .bad")).to_contain_text("1 to 64 characters")
    page.fill("#entry-name", "armchair")
    page.select_option("#entry-symmetry", "detected")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".tile h2")).to_have_text("armchair")
    expect(page.locator(".tile")).not_to_contain_text("as given")
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
    page.locator("dialog[open]").get_by_role("button", name="Remove").click()
    expect(page.locator(".tile")).to_have_count(0)
    page.goto(f"{service}/fields")
    page.get_by_role("link", name="Add to library").click()
    expect(page.locator("#entry-name")).to_have_value("chair")
    assert [one for one in visit.complaints if not one.startswith(NETWORK)] == []
    assert [url for url in visit.requests if not url.startswith((service + "/", "blob:"))] == []
