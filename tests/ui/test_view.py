"""The page of a finished job: what is drawn and what moves."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.fixture_server import TOKEN
from tests.ui.pixels import canvas_pixels, center_of, changed_share, colored, differs, overlap
from tests.ui.stories import LABELS
from tests.ui.synthetic import ITERATIONS

pytestmark = pytest.mark.browser
ROOM, CHAIR = LABELS["a3"], LABELS["7c"]


def seek(visit: Visit, position: int) -> None:
    visit.page.locator("#iteration").fill(str(position))


def hide(visit: Visit, *layers: str) -> None:
    for layer in layers:
        visit.page.locator(f"label.chip[data-layer={layer}]").click()


def test_draws_the_clouds_and_stays_at_home(visit: Visit) -> None:
    page = visit.open("done")
    pixels = canvas_pixels(page)
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 500
    assert colored(pixels, "blue").mean() > 0.01
    assert colored(pixels, "orange").mean() > 0.005
    assert visit.complaints == []
    assert visit.requests
    assert [url for url in visit.requests if not url.startswith(visit.server.origin + "/")] == []


def test_every_layer_can_be_hidden_and_shown_again(visit: Visit) -> None:
    page = visit.open("done")
    shown = canvas_pixels(page)
    for layer, least in (("scene", 0.2), ("before", 0.005), ("after", 0.005), ("box", 0.001)):
        hide(visit, layer)
        assert changed_share(shown, canvas_pixels(page)) > least, layer
        hide(visit, layer)
        assert changed_share(shown, canvas_pixels(page)) < 0.001, layer


def test_surroundings_are_a_layer_of_their_own_where_the_result_has_them(visit: Visit) -> None:
    page = visit.open("roomy")
    hide(visit, "scene")
    shown = canvas_pixels(page)
    hide(visit, "context")
    assert changed_share(shown, canvas_pixels(page)) > 0.02
    visit.open("done")
    expect(page.locator("#context-chip")).to_be_hidden()


def test_slider_moves_the_object_from_the_start_into_place(visit: Visit) -> None:
    page = visit.open("done")
    page.locator("#frame-all").click()
    hide(visit, "scene", "box")
    seek(visit, 0)
    expect(page.locator("#iteration-text")).to_have_text("Start")
    hide(visit, "before")
    start = colored(canvas_pixels(page), "blue")
    hide(visit, "before", "after")
    ghost = colored(canvas_pixels(page), "orange")
    # At the start the object stands where its ghost does ...
    assert math.dist(center_of(start), center_of(ghost)) < 6
    hide(visit, "before", "after")
    seek(visit, 5)
    expect(page.locator("#iteration-text")).to_contain_text("Iteration 5")
    halfway = colored(canvas_pixels(page), "blue")
    seek(visit, ITERATIONS + 1)
    end = colored(canvas_pixels(page), "blue")
    # ... and every step brings it nearer to its place.
    assert math.dist(center_of(start), center_of(end)) > math.dist(center_of(halfway), center_of(end)) > 6


def test_result_lies_on_the_scene(visit: Visit) -> None:
    page = visit.open("done")
    page.locator("#color").select_option("residual")  # its scene points are those of the chair alone
    page.wait_for_selector("#legend svg rect")
    hide(visit, "before", "box", "scene", "after")
    nothing = canvas_pixels(page)
    hide(visit, "scene")
    chair_in_scene = differs(nothing, canvas_pixels(page))
    hide(visit, "scene", "after")
    assert overlap(chair_in_scene, differs(nothing, canvas_pixels(page))) > 0.8
    seek(visit, 0)
    assert overlap(chair_in_scene, differs(nothing, canvas_pixels(page))) < 0.4


def test_residuals_color_the_clouds_and_the_up_axis_turns_them(visit: Visit) -> None:
    page = visit.open("done")
    before = canvas_pixels(page)
    page.locator("#color").select_option("residual")
    page.wait_for_selector("#legend svg rect")
    assert changed_share(before, canvas_pixels(page)) > 0.02
    expect(page.locator("#legend")).to_be_visible()
    page.locator("#color").select_option("layer")
    expect(page.locator("#legend")).to_be_hidden()
    assert changed_share(before, canvas_pixels(page)) < 0.001
    page.locator("#up").select_option("y")
    assert changed_share(before, canvas_pixels(page)) > 0.2
    page.locator("#up").select_option("z")
    assert changed_share(before, canvas_pixels(page)) < 0.001
    assert visit.complaints == []


def test_mouse_and_keys_move_the_camera(visit: Visit) -> None:
    page = visit.open("done")
    home = canvas_pixels(page)
    box = page.locator("#canvas").bounding_box()
    assert box is not None
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


def test_play_runs_from_the_start_to_the_result(visit: Visit) -> None:
    page = visit.open("done")
    page.locator("#canvas").focus()
    page.keyboard.press("Space")
    page.wait_for_selector("#play[data-playing]")
    page.keyboard.press("Space")
    page.wait_for_selector("#play:not([data-playing])")
    page.locator("#iteration").fill(str(ITERATIONS + 1))
    expect(page.locator("#iteration-text")).to_have_text("Result")
    page.evaluate(
        """() => {
            const text = document.querySelector("#iteration-text");
            window.shown = [];
            new MutationObserver(() => window.shown.push(text.textContent)).observe(text, { childList: true });
        }"""
    )
    page.locator("#play").click()
    page.wait_for_selector("#play[data-playing]")
    page.wait_for_function("() => window.shown.length > 1 && window.shown.at(-1) === 'Result'", timeout=30_000)
    assert re.match(r"Start|Iteration 1?\d ", page.evaluate("window.shown[0]")), "what it begins with, however slow"
    expect(page.locator("#play")).not_to_have_attribute("data-playing", "")
    expect(page.locator("#iteration")).to_have_value(str(ITERATIONS + 1))


def colors_of_the_fields(visit: Visit) -> list[str]:
    """The color in the middle of each field's picture; the fixture's are all of one color."""
    visit.page.wait_for_selector("#fields:not([hidden])")
    program = """all => all.map(one => {
        const [r, g, b] = one.getContext('2d').getImageData(one.width / 2, one.height / 2, 1, 1).data;
        return [r, g, b].map(value => value.toString(16).padStart(2, '0')).join('');
    })"""
    colors: list[str] = visit.page.locator("#field-pictures canvas").evaluate_all(program)
    return colors


def test_the_fields_pictures_are_shown_and_every_artifact_can_be_downloaded(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("done")
    assert colors_of_the_fields(visit) == ["a3" * 3, "7c" * 3]
    expect(page.locator("#field-pictures figcaption")).to_have_text([f"Scene: {ROOM}", f"Object: {CHAIR}"])
    labels = page.locator("#field-pictures canvas").evaluate_all("all => all.map(one => one.ariaLabel)")
    assert [label.split(":")[0] for label in labels] == ["Scene", "Object"]
    stage = visit.server.stage.data
    expect(page.locator("#files a")).to_have_text([one["name"] for one in stage.result["artifacts"]])
    with page.expect_download() as download:
        page.locator("#files a", has_text="trace.json").click()
    download.value.save_as(tmp_path / "trace.json")
    assert (tmp_path / "trace.json").read_bytes() == stage.artifacts["trace.json"]


def test_fields_without_a_picture_have_no_card(visit: Visit) -> None:
    visit.page.route("**/preview.png", lambda route: route.fulfill(status=404, json={"reason": "NONE"}))
    with visit.page.expect_response("**/preview.png"):
        page = visit.open("done")
    expect(page.locator("#fields")).to_be_hidden()
    expect(page.locator("#verdict-word")).to_have_text("Registered")


def test_damaged_cloud_leaves_the_numbers(visit: Visit) -> None:
    page = visit.open("broken")
    expect(page.locator("#message-title")).to_have_text("The 3D view cannot be shown")
    expect(page.locator("#verdict-word")).to_have_text("Registered")


@pytest.mark.usefixtures("own_page")
def test_no_webgl_leaves_the_numbers(visit: Visit) -> None:
    visit.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = visit.open("done")
    expect(page.locator("#message-text")).to_contain_text("WebGL 2")
    expect(page.locator("#matrix td")).to_have_count(16)


def test_token_opens_page_and_downloads(visit: Visit, tmp_path: Path) -> None:
    page = visit.open("locked")
    expect(page.locator("#message-title")).to_have_text("This service asks for a token")
    page.locator("#token").fill("wrong")
    page.keyboard.press("Enter")
    page.wait_for_selector("#token-form:not([hidden])")
    page.locator("#token").fill(TOKEN)
    page.keyboard.press("Enter")
    page.wait_for_selector("#tools:not([hidden])")
    expect(page.locator("#field-pictures canvas")).to_have_count(2)
    with page.expect_download() as download:
        page.locator("#files a", has_text="trace.json").click()
    download.value.save_as(tmp_path / "trace.json")
    assert (tmp_path / "trace.json").read_bytes() == visit.server.stage.data.artifacts["trace.json"]
    assert TOKEN not in " ".join(visit.requests)


def test_object_flies_into_place_by_itself(visit: Visit) -> None:
    visit.page.emulate_media(reduced_motion="no-preference")
    visit.page.goto(visit.server.view("done"))
    visit.page.wait_for_selector("#play[data-playing]")
    expect(visit.page.locator("#iteration-text")).to_have_text("Result", timeout=30_000)
