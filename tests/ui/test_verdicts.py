"""What the page tells of the preset `robust`: words, twins to choose from, deviations, covariance, options."""

from __future__ import annotations

import numpy as np
import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.pixels import canvas_pixels, changed_share
from tests.ui.verdicts import DETAIL, ORDERING, SIGMAS, WARNING

pytestmark = pytest.mark.browser


def numbers(texts: list[str]) -> list[float]:
    return [float(text.replace("±", "").replace("−", "-")) for text in texts]


def test_what_is_known_of_a_pose_is_told(visit: Visit) -> None:
    """The reason in words and what to do, the imports' warnings, deviations, covariance and options of the document."""
    page = visit.open("ambiguous")
    expect(page.locator("#status")).to_have_text("Ambiguous")
    for part in (DETAIL, "SEVERAL_POSES_AGREE", "up_axis"):
        expect(page.locator("#verdict-reason")).to_contain_text(part)
    expect(page.locator("#figures")).to_contain_text("± 0.5 %")
    expect(page.locator("#warnings li")).to_have_text([f"Scene: {WARNING}"])
    expect(page.locator("#certainty-words")).to_contain_text("If the pose is right, it is known: its center to ± ")
    shown = numbers(page.locator("#sigmas .mono:last-child").all_inner_texts())
    assert shown == [0.003, 0.001, 0.002, 0.4, 0.8, 0.2, 0.5]
    widths = page.locator("#sigmas .track span").evaluate_all("all => all.map(one => parseFloat(one.style.width))")
    assert widths == pytest.approx([100, 100 / 3, 200 / 3, 40, 80, 20, 50], rel=1e-3)  # a degree, a per cent
    assert page.locator("#symmetry").inner_text().split("\n") == [
        "Symmetry of the object",
        "2 rotations about (0.00, 0.00, 1.00) look the same",
    ]
    expect(page.locator("#covariance")).to_be_hidden()
    page.locator("#covariance-details summary").click()
    expect(page.locator("#covariance")).to_be_visible()
    assert page.locator("#covariance thead th").all_inner_texts() == ORDERING
    assert page.locator("#covariance tbody th").all_inner_texts() == ORDERING
    texts = page.locator("#covariance tbody td").all_inner_texts()
    cells = np.reshape(numbers([text.replace("e−", "e-") for text in texts]), (7, 7))
    np.testing.assert_allclose(cells.diagonal(), np.square(SIGMAS), rtol=0.05)
    assert cells[0, 3] == pytest.approx(0.3 * SIGMAS[0] * SIGMAS[3], rel=0.05)
    assert cells[0, 1] == 0
    expect(page.locator("#preset")).to_have_text("preset robust")
    page.locator("#options summary").click()
    expect(page.locator("#option-groups div").first).to_be_visible()
    assert page.locator("#option-groups div").all_inner_texts() == ["rotations\n600", "inlier_distance\n0.015"]


def test_every_alternative_moves_the_object_and_the_result_comes_back(visit: Visit) -> None:
    page = visit.open("ambiguous")
    assert page.locator("#pose-list label").all_inner_texts() == [
        "The result\n0.041",
        "172 degrees about z\n0.043",
        "180 degrees about x\n0.071",
    ]
    result, matrix = canvas_pixels(page), page.locator("#matrix").inner_text()
    shown = {matrix}
    for relation in ("172 degrees about z", "180 degrees about x"):
        page.locator("#pose-list label", has_text=relation).click()
        expect(page.locator("#transform-note")).to_have_text(f"An alternative: {relation}")
        assert changed_share(result, canvas_pixels(page)) > 0.005
        expect(page.locator("#iteration-text")).to_have_text("Alternative")
        shown.add(page.locator("#matrix").inner_text())
    assert len(shown) == 3
    page.locator("#pose-list label", has_text="The result").click()
    expect(page.locator("#transform-note")).to_be_hidden()
    assert changed_share(result, canvas_pixels(page)) < 0.001
    expect(page.locator("#matrix")).to_have_text(matrix, use_inner_text=True)
    expect(page.locator("#iteration-text")).to_have_text("Result")
    page.locator("#pose-list input").first.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#pose-list input").nth(1)).to_be_checked()
    expect(page.locator("#transform-note")).to_have_text("An alternative: 172 degrees about z")
    page.locator("#iteration").fill("3")  # the path leads to the result: choosing it again
    expect(page.locator("#pose-list input").first).to_be_checked()
    expect(page.locator("#matrix")).to_have_text(matrix, use_inner_text=True)


def test_residual_colors_say_whose_they_are(visit: Visit) -> None:
    page = visit.open("ambiguous")
    page.locator("#color").select_option("residual")
    page.wait_for_selector("#legend svg rect")
    caption = page.locator("#legend figcaption")
    expect(caption).to_have_text("Residual, object units")
    page.locator("#pose-list label", has_text="172 degrees").click()
    expect(caption).to_contain_text("of the result’s pose, not of the one shown")
    page.locator("#pose-list label", has_text="The result").click()
    expect(caption).to_have_text("Residual, object units")
    page.locator("#iteration").fill("3")
    expect(caption).to_contain_text("of the result’s pose")


def test_a_search_shows_its_ranking(visit: Visit) -> None:
    page = visit.open("searched")
    expect(page.locator("#ranking-note")).to_have_text("12 candidates")
    expect(page.locator("#ranking-list li").last).to_contain_text("field b5b5b5b5")  # the names come after the rest
    shown = [text.split("\n") for text in page.locator("#ranking-list li").all_inner_texts()]
    assert shown[:3] == [
        ["field a0a0a0a0", "Registered", "0.021"],
        ["field a1a1a1a1", "Rejected", "0.34"],
        ["field b0b0b0b0", "searched coarsely", "0.4"],
    ]
    assert len(shown) == 8
    page.locator("#ranking-more summary").click()
    expect(page.locator("#ranking-rest li").last).to_contain_text("field d0d0d0d0")
    rest = [text.split("\n") for text in page.locator("#ranking-rest li").all_inner_texts()]
    assert [len(rest), rest[-1]] == [4, ["field d0d0d0d0", "no object", "–"]]
    assert page.locator("#job-facts [title]", has_text="field a0a0a0a0").get_attribute("title") == "a0" * 32


def test_the_axis_that_the_options_name_points_up(visit: Visit) -> None:
    page = visit.open("tipped")
    expect(page.locator("#up")).to_have_value("y")
    tipped = canvas_pixels(page)
    page.locator("#up").select_option("z")
    assert changed_share(tipped, canvas_pixels(page)) > 0.2


def test_results_that_know_nothing_of_all_this_are_shown_without(visit: Visit) -> None:
    page = visit.open("done")
    for card in ("ranking", "poses", "certainty", "options"):
        expect(page.locator(f"#{card}")).to_be_hidden()
    expect(page.locator("#verdict-reason")).to_contain_text("Surfaces agree")


@pytest.mark.usefixtures("own_page")
def test_without_a_view_the_alternatives_still_have_their_numbers(visit: Visit) -> None:
    visit.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = visit.open("ambiguous")
    matrix = page.locator("#matrix").inner_text()
    page.locator("#pose-list label", has_text="180 degrees about x").click()
    expect(page.locator("#transform-note")).to_have_text("An alternative: 180 degrees about x")
    assert page.locator("#matrix").inner_text() != matrix
