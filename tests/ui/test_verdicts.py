"""What the page of a finished job tells in words and numbers: the transform, how sure it is, other poses, names."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.ui.conftest import Visit
from tests.ui.home import canvas_pixels, changed_share
from tests.ui.stories import DETAIL, LABELS, OPTIONS, ORDERING, SIGMAS, WARNING, WEB
from tests.ui.test_access import NONE, in_both_themes

pytestmark = pytest.mark.browser
ROOM, CHAIR = LABELS["a3"], LABELS["7c"]


def numbers(texts: list[str]) -> list[float]:
    return [float(text.replace("±", "").replace("e−", "e-").replace("−", "-")) for text in texts]


def assert_matrix(page: Page, matrix: list[list[float]]) -> None:
    cells = numbers(page.locator("#matrix td").all_inner_texts())
    assert np.allclose(np.reshape(cells, (4, 4)), matrix, atol=5.1e-6)


def test_numbers_are_the_documents(visit: Visit) -> None:
    page = visit.page
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    visit.open("done")
    result = visit.server.stage.data.result
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    for part in ("SURFACES_AGREE", "Surfaces agree"):
        expect(page.locator("#verdict-reason")).to_contain_text(part)
    assert_matrix(page, result["T_scene_object"]["matrix"])
    page.locator("#copy-matrix").click()
    expect(page.locator("#copy-matrix")).to_have_text("Copied")
    copied = json.loads(page.evaluate("navigator.clipboard.readText()"))
    assert np.allclose(copied, np.linalg.inv(visit.server.stage.data.T_object_scene), atol=1e-12)
    before = page.locator("#matrix").inner_text()
    page.locator("input[name=direction][value=T_object_scene]").check(force=True)
    expect(page.locator("#matrix")).not_to_have_text(before, use_inner_text=True)
    assert_matrix(page, result["T_object_scene"]["matrix"])
    # created 20:26:40, finished 20:26:54
    for figure in ("97.3 %", "; level default", "1.6000", "93.1 %", "0.41 %", "12.3 s", "14.0 s"):
        expect(page.locator("#figures")).to_contain_text(figure)
    expect(page.locator("#time-total")).to_have_text("12.3 s of 14.0 s from request to result")
    about = json.loads((WEB / "metrics.json").read_text(encoding="utf-8"))
    said = page.locator("#agreement").inner_text()
    assert [n for n in result["metrics"] if not n.startswith("seconds") and about[n]["meaning"] not in said] == []
    assert page.locator("#shares").inner_text().split("\n")[:2] == ["Scene inliers", "96.2 %"]
    expect(page.locator("#time-key li")).to_have_count(6)
    for card in ("ranking", "poses", "certainty", "options", "considered"):  # the result knows nothing of these
        expect(page.locator(f"#{card}")).to_be_hidden()


@pytest.mark.parametrize("diameter", [None, 0.5])
def test_the_curve_is_in_units_or_in_shares_of_the_diameter_where_that_is_known(
    visit: Visit, diameter: float | None
) -> None:
    data = visit.server.stage.data
    if diameter is not None:
        result = data.result | {"metrics": data.result["metrics"] | {"object_diameter": diameter}}
        visit.page.route("**/result", lambda route: route.fulfill(status=200, json=result))
    page = visit.open("done")
    unit = "object units" if diameter is None else "of the diameter"
    expect(page.locator("#distance-note")).to_contain_text(unit)
    label = page.locator("#distance svg").get_attribute("aria-label")
    told = re.fullmatch(rf"Mean distance over 40 iterations, from (\S+) to (\S+) {unit}", label or "")
    assert told is not None, label
    last = json.loads(data.artifacts["trace.json"])[-1]
    end = (last["residual_scene"] + 1.6 * last["residual_object"]) / 2  # the latter is in the scene's units
    assert float(told[2]) == pytest.approx(end / (diameter or 1.0), rel=0.01)
    assert float(told[1]) > 5 * float(told[2])


def test_fields_are_called_by_their_names(visit: Visit) -> None:
    page = visit.open("done")
    expect(page.locator("#job-title")).to_have_text(f"{CHAIR} in {ROOM}")
    expect(page).to_have_title(f"{CHAIR} in {ROOM} – regnf")
    for part in (OPTIONS, ROOM, CHAIR):
        expect(page.locator("#job-facts")).to_contain_text(part)
    assert any("7c" * 32 in url for url in visit.requests)
    assert not any(OPTIONS in url for url in visit.requests), "a digest, and not one of a field"
    assert "a3" * 32 not in page.locator("body").inner_text()
    expect(page.locator("#job-facts [title]").first).to_have_attribute("title", "a3" * 32)
    page.route("**/fields/*", lambda route: route.fulfill(status=404, json={"reason": "FIELD_NOT_FOUND"}))
    page.reload()
    expect(page.locator("#job-title")).to_have_text(f"{('7c' * 32)[:8]} in {('a3' * 32)[:8]}")
    page.unroute("**/fields/*")
    visit.open("labeled")  # nobody gave its object a label: the field's file carries one
    expect(page.locator("#job-title")).to_have_text(f"stool in {ROOM}")


def test_what_is_known_of_a_pose_is_told(visit: Visit) -> None:
    """The reason in words and what to do, the imports' warnings, deviations, covariance and options of the document."""
    page = visit.open("ambiguous")
    expect(page.locator("#status")).to_have_text("Ambiguous")
    for part in (DETAIL, "SEVERAL_POSES_AGREE", "up_axis"):
        expect(page.locator("#verdict-reason")).to_contain_text(part)
    expect(page.locator("#figures")).to_contain_text("± 0.5 %")
    expect(page.locator("#warnings li")).to_have_text([f"Scene: {WARNING}"])
    expect(page.locator("#certainty-words")).to_contain_text(
        "If the pose is correct, it is known: its center within ± "
    )
    shown = numbers(page.locator("#sigmas .mono:last-child").all_inner_texts())
    assert shown == [0.003, 0.001, 0.002, 0.4, 0.8, 0.2, 0.5]
    widths = page.locator("#sigmas .track span").evaluate_all("all => all.map(one => parseFloat(one.style.width))")
    assert widths == pytest.approx([100, 100 / 3, 200 / 3, 40, 80, 20, 50], rel=1e-3)  # a degree, a per cent
    symmetry = ["Symmetry of the object", "2 rotations about (0.00, 0.00, 1.00) look the same"]
    assert page.locator("#symmetry").inner_text().split("\n") == symmetry
    expect(page.locator("#covariance")).to_be_hidden()
    page.locator("#covariance-details summary").click()
    expect(page.locator("#covariance")).to_be_visible()
    for heads in ("#covariance thead th", "#covariance tbody th"):
        assert page.locator(heads).all_inner_texts() == ORDERING
    cells = np.reshape(numbers(page.locator("#covariance tbody td").all_inner_texts()), (7, 7))
    np.testing.assert_allclose(cells.diagonal(), np.square(SIGMAS), rtol=0.05)
    assert cells[0, 3] == pytest.approx(0.3 * SIGMAS[0] * SIGMAS[3], rel=0.05)
    assert cells[0, 1] == 0
    expect(page.locator("#preset")).to_have_text("preset robust")
    page.locator("#options summary").click()
    expect(page.locator("#option-groups div").first).to_be_visible()
    assert page.locator("#option-groups div").all_inner_texts() == ["rotations\n600", "inlier_distance\n0.015"]


def test_every_alternative_moves_the_object_and_the_result_comes_back(visit: Visit) -> None:
    page = visit.open("ambiguous")
    poses, note = page.locator("#pose-list label"), page.locator("#transform-note")
    relations = ["172 degrees about z", "180 degrees about x"]
    listed = ["The result\n0.041", f"{relations[0]}\n0.043", f"{relations[1]}\n0.071"]
    assert poses.all_inner_texts() == listed
    result, matrix = canvas_pixels(page), page.locator("#matrix").inner_text()
    shown = {matrix}
    for relation in relations:
        poses.filter(has_text=relation).click()
        expect(note).to_have_text(f"An alternative: {relation}")
        assert changed_share(result, canvas_pixels(page)) > 0.005
        expect(page.locator("#iteration-text")).to_have_text("Alternative")
        shown.add(page.locator("#matrix").inner_text())
    assert len(shown) == 3
    poses.first.click()
    expect(note).to_be_hidden()
    assert changed_share(result, canvas_pixels(page)) < 0.001
    expect(page.locator("#matrix")).to_have_text(matrix, use_inner_text=True)
    expect(page.locator("#iteration-text")).to_have_text("Result")
    page.locator("#color").select_option("residual")
    page.wait_for_selector("#legend svg rect")
    caption = page.locator("#legend figcaption")
    expect(caption).to_have_text("Residual, object units")
    page.locator("#pose-list input").first.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#pose-list input").nth(1)).to_be_checked()
    expect(note).to_have_text(f"An alternative: {relations[0]}")
    expect(caption).to_contain_text("for the result’s pose, not for the displayed one")
    page.locator("#iteration").fill("3")  # the path leads to the result: choosing it again
    expect(page.locator("#pose-list input").first).to_be_checked()
    expect(page.locator("#matrix")).to_have_text(matrix, use_inner_text=True)
    expect(caption).to_contain_text("for the result’s pose")


def test_a_search_shows_its_ranking(visit: Visit) -> None:
    page = visit.open("searched")
    expect(page.locator("#ranking-note")).to_have_text("12 candidates")
    expect(page.locator("#ranking-list li").last).to_contain_text("field b5b5b5b5")  # the names come after the rest
    shown = [text.split("\n") for text in page.locator("#ranking-list li").all_inner_texts()]
    assert shown[:3] == [
        ["field a0a0a0a0", "Registered, 99.0 %, strict", "0.021"],
        ["field a1a1a1a1", "Rejected, 30.0 %, below both levels", "0.34",
         "distinguished from the first by 3.7 % of the surface, which was observed"],
        ["field b0b0b0b0", "coarse search", "0.4"],
    ]  # fmt: skip
    assert len(shown) == 8
    page.locator("#ranking-more summary").click()
    expect(page.locator("#ranking-rest li").last).to_contain_text("field d0d0d0d0")
    rest = [text.split("\n") for text in page.locator("#ranking-rest li").all_inner_texts()]
    assert [len(rest), rest[-1]] == [4, ["field d0d0d0d0", "unusable", "–"]]
    expect(page.locator("#job-facts [title]", has_text="field a0a0a0a0")).to_have_attribute("title", "a0" * 32)


def red_share(page: Page) -> float:
    red, green, blue = np.moveaxis(canvas_pixels(page), -1, 0)
    return float(((red - green > 90) & (red - blue > 90)).mean())


def test_a_rejected_pose_is_shown_with_what_speaks_against_it(visit: Visit) -> None:
    page = visit.open("judged")
    poses = page.locator("#considered-list label")
    expect(poses).to_contain_text(["97.0 %, default", "2.0 %, below both levels"])
    expect(poses).to_contain_text(["The surfaces match.", "<b>FREE_SPACE_VIOLATED</b>"])
    before = page.locator("#matrix").inner_text()
    red = red_share(page)
    poses.nth(1).locator("input").check()
    expect(page.locator("#considered-facts")).to_contain_text("40.0 %")
    expect(page.locator("#transform-note")).to_have_text("A candidate pose")
    expect(page.locator("#considered-key")).to_be_visible()
    expect(page.locator("#matrix")).not_to_have_text(before, use_inner_text=True)
    assert red_share(page) > red + 0.002
    assert in_both_themes(page) == NONE
    page.emulate_media(color_scheme="light")
    page.locator("#iteration").press("End")
    page.locator("#iteration").press("Home")
    expect(page.locator("#considered-list input:checked")).to_have_count(0)
    assert red_share(page) == pytest.approx(red, abs=0.001)
    assert visit.complaints == []
