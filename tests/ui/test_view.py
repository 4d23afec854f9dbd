"""The page of a finished job: what is drawn and what moves, as samples and as meshes."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.ui.conftest import Visit
from tests.ui.home import Mask, blue, box_of, canvas_pixels, changed_share, differs, orange, overlap
from tests.ui.stories import LABELS, TOKEN
from tests.ui.synthetic import ITERATIONS

pytestmark = pytest.mark.browser
VIEWPORT = (1100, 700)
ROOM, CHAIR = LABELS["a3"], LABELS["7c"]


def seek(page: Page, position: int) -> None:
    page.locator("#iteration").fill(str(position))


def toggle(page: Page, *layers: str) -> None:
    for layer in layers:
        page.locator(f"label.chip[data-layer={layer}]").click()


def assert_layers(page: Page, least: dict[str, float]) -> None:
    """Each can be hidden, which changes this share of the view at least, and shown again."""
    shown = canvas_pixels(page)
    for layer, share in least.items():
        toggle(page, layer)
        assert changed_share(shown, canvas_pixels(page)) > share, layer
        toggle(page, layer)
        assert changed_share(shown, canvas_pixels(page)) < 0.001, layer


def distance(one: Mask, other: Mask) -> float:
    return math.dist(*(np.argwhere(mask).mean(axis=0) for mask in (one, other)))


def test_draws_the_clouds_in_layers_and_stays_at_home(visit: Visit) -> None:
    page = visit.open("done")
    assert len(np.unique(canvas_pixels(page).reshape(-1, 3), axis=0)) > 500
    assert blue(page).mean() > 0.01
    assert orange(page).mean() > 0.005
    assert_layers(page, {"scene": 0.2, "before": 0.005, "after": 0.005, "box": 0.001})
    expect(page.locator("#context-chip")).to_be_hidden()
    expect(page.locator("#surfaces-dial")).to_be_hidden()
    assert visit.complaints == []
    assert visit.requests
    assert [url for url in visit.requests if not url.startswith(visit.server.origin + "/") or "mesh.glb" in url] == []


def test_surroundings_are_a_layer_of_their_own_where_the_result_has_them(visit: Visit) -> None:
    page = visit.open("roomy")
    toggle(page, "scene")
    shown = canvas_pixels(page)
    toggle(page, "context")
    assert changed_share(shown, canvas_pixels(page)) > 0.02


def test_slider_moves_the_object_from_the_start_into_place(visit: Visit) -> None:
    page = visit.open("done")
    page.locator("#frame-all").click()
    toggle(page, "scene", "box")
    seek(page, 0)
    expect(page.locator("#iteration-text")).to_have_text("Start")
    toggle(page, "before")
    start = blue(page)
    toggle(page, "before", "after")
    # At the start the object stands where its ghost does ...
    assert distance(start, orange(page)) < 6
    toggle(page, "before", "after")
    seek(page, 5)
    expect(page.locator("#iteration-text")).to_contain_text("Iteration 5")
    halfway = blue(page)
    seek(page, ITERATIONS + 1)
    end = blue(page)
    # ... and every step brings it nearer to its place.
    assert distance(start, end) > distance(halfway, end) > 6


def test_residuals_color_the_clouds_and_the_result_lies_on_the_scene(visit: Visit) -> None:
    page = visit.open("done")
    before = canvas_pixels(page)
    page.locator("#color").select_option("residual")  # its scene points are those of the chair alone
    page.wait_for_selector("#legend svg rect")
    assert changed_share(before, canvas_pixels(page)) > 0.02
    toggle(page, "before", "box", "scene", "after")
    nothing = canvas_pixels(page)
    toggle(page, "scene")
    chair_in_scene = differs(nothing, canvas_pixels(page))
    toggle(page, "scene", "after")
    assert overlap(chair_in_scene, differs(nothing, canvas_pixels(page))) > 0.8
    seek(page, 0)
    assert overlap(chair_in_scene, differs(nothing, canvas_pixels(page))) < 0.4
    seek(page, ITERATIONS + 1)
    toggle(page, "before", "box", "scene")
    page.locator("#color").select_option("layer")
    expect(page.locator("#legend")).to_be_hidden()
    assert changed_share(before, canvas_pixels(page)) < 0.001
    assert visit.complaints == []


def test_mouse_keys_and_the_up_axis_move_the_camera(visit: Visit) -> None:
    page = visit.open("done")
    home = canvas_pixels(page)
    page.locator("#up").select_option("y")
    assert changed_share(home, canvas_pixels(page)) > 0.2
    page.locator("#up").select_option("z")
    assert changed_share(home, canvas_pixels(page)) < 0.001
    box = box_of(page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y + 20, steps=4)
    page.mouse.up()
    assert changed_share(home, canvas_pixels(page)) > 0.1
    page.locator("#frame-object").click()
    page.locator("#canvas").focus()
    for key in ("ArrowLeft", "Shift+ArrowUp", "+"):
        before = canvas_pixels(page)
        page.keyboard.press(key)
        assert changed_share(before, canvas_pixels(page)) > 0.05, key
    visit.open("tipped")
    expect(page.locator("#up")).to_have_value("y")  # the axis that the options name


def test_play_runs_from_the_start_to_the_result(visit: Visit) -> None:
    page = visit.open("done")
    page.locator("#canvas").focus()
    page.keyboard.press("Space")
    page.wait_for_selector("#play[data-playing]")
    page.keyboard.press("Space")
    page.wait_for_selector("#play:not([data-playing])")
    seek(page, ITERATIONS + 1)
    expect(page.locator("#iteration-text")).to_have_text("Result")
    page.evaluate(
        """() => {
            const text = document.querySelector("#iteration-text");
            window.shown = [];
            new MutationObserver(() => window.shown.push(text.textContent)).observe(text, { childList: true });
        }"""
    )
    page.locator("#play").click()
    page.wait_for_function("() => window.shown.length > 1 && window.shown.at(-1) === 'Result'", timeout=30_000)
    assert re.match(r"Start|Iteration 1?\d ", page.evaluate("window.shown[0]")), "what it begins with, however slow"
    expect(page.locator("#play")).not_to_have_attribute("data-playing", "")
    expect(page.locator("#iteration")).to_have_value(str(ITERATIONS + 1))
    page.emulate_media(reduced_motion="no-preference")
    page.goto(visit.server.view("done"))
    page.wait_for_selector("#play[data-playing]")  # by itself
    expect(page.locator("#iteration-text")).to_have_text("Result", timeout=30_000)


def download_trace(visit: Visit, folder: Path) -> bytes:
    with visit.page.expect_download() as download:
        visit.page.locator("#files a", has_text="trace.json").click()
    download.value.save_as(folder / "trace.json")
    return (folder / "trace.json").read_bytes()


def test_the_fields_pictures_are_shown_and_every_artifact_can_be_downloaded(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("done")
    pictures = page.locator("#field-pictures canvas")
    expect(pictures).to_have_count(2)
    # the fixture's are all of one color
    program = """all => all.map(one => {
        const [r, g, b] = one.getContext('2d').getImageData(one.width / 2, one.height / 2, 1, 1).data;
        return [r, g, b].map(value => value.toString(16).padStart(2, '0')).join('');
    })"""
    assert pictures.evaluate_all(program) == ["a3" * 3, "7c" * 3]
    expect(page.locator("#field-pictures figcaption")).to_have_text([f"Scene: {ROOM}", f"Object: {CHAIR}"])
    labels = pictures.evaluate_all("all => all.map(one => one.ariaLabel)")
    assert [label.split(":")[0] for label in labels] == ["Scene", "Object"]
    data = visit.server.stage.data
    expect(page.locator("#files a")).to_have_text([one["name"] for one in data.result["artifacts"]])
    assert download_trace(visit, tmp_path) == data.artifacts["trace.json"]


def test_token_opens_page_and_downloads(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("locked")
    expect(page.locator("#message-title")).to_have_text("This service needs a token")
    page.locator("#token").fill("wrong")
    page.keyboard.press("Enter")
    page.wait_for_selector("#token-form:not([hidden])")
    page.locator("#token").fill(TOKEN)
    page.keyboard.press("Enter")
    page.wait_for_selector("#tools:not([hidden])")
    expect(page.locator("#field-pictures canvas")).to_have_count(2)
    assert download_trace(visit, tmp_path) == visit.server.stage.data.artifacts["trace.json"]
    assert TOKEN not in " ".join(visit.requests)


def test_what_is_missing_or_damaged_leaves_the_numbers(visit: Visit) -> None:
    page = visit.open("broken")
    expect(page.locator("#message-title")).to_have_text("The 3D view cannot be displayed")
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    page.route("**/preview.png", lambda route: route.fulfill(status=404, json={"reason": "NONE"}))
    with page.expect_response("**/preview.png"):
        visit.open("bare")  # without trace and start, and its fields without pictures
    assert blue(page).mean() > 0.01
    for part in ("#timeline", "#before-chip", "#convergence", "#fields"):
        expect(page.locator(part)).to_be_hidden()
    expect(page.locator("#verdict-word")).to_have_text("Registered")


@pytest.mark.usefixtures("own_page")
def test_without_webgl_there_are_the_numbers_and_the_alternatives(visit: Visit) -> None:
    visit.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = visit.open("ambiguous")
    expect(page.locator("#message-text")).to_contain_text("WebGL 2")
    expect(page.locator("#matrix td")).to_have_count(16)
    matrix = page.locator("#matrix").inner_text()
    page.locator("#pose-list label", has_text="180 degrees about x").click()
    expect(page.locator("#transform-note")).to_have_text("An alternative: 180 degrees about x")
    expect(page.locator("#matrix")).not_to_have_text(matrix, use_inner_text=True)


# display meshes


def test_meshes_are_drawn_where_the_samples_lie(visit: Visit) -> None:
    """Each is a layer, moves with the iterations, and what is hidden stays hidden as samples."""
    page = visit.open("meshed")
    expect(page.locator("#surfaces")).to_have_value("meshes")
    expect(page.locator("#size-dial")).to_be_hidden()
    assert_layers(page, {"scene": 0.002, "context": 0.05, "before": 0.005, "after": 0.005})
    toggle(page, "before", "box")
    mesh = blue(page)
    seek(page, 0)
    assert overlap(mesh, blue(page)) < 0.5
    seek(page, ITERATIONS + 1)
    toggle(page, "after")
    page.locator("#surfaces").select_option("discs")
    expect(page.locator("#size-dial")).to_be_visible()
    assert blue(page).mean() < 0.001
    toggle(page, "after")
    samples = blue(page)
    assert mesh.mean() > 0.02
    assert 1 > overlap(mesh, samples) > 0.6
    assert visit.complaints == []


def test_a_mesh_that_is_gone_leaves_the_samples(visit: Visit) -> None:
    problem = {"reason": "FIELD_VIEW_NOT_FOUND"}
    visit.page.route("**/mesh.glb*", lambda route: route.fulfill(status=404, json=problem))
    page = visit.open("meshed")
    expect(page.locator("#surfaces-dial")).to_be_hidden()
    assert blue(page).mean() > 0.01
