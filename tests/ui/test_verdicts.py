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


def test_the_reason_is_told_in_words_and_what_to_do(visit: Visit) -> None:
    page = visit.open("ambiguous")
    assert page.locator("#status").inner_text() == "Ambiguous"
    said = page.locator("#verdict-reason").inner_text()
    assert DETAIL in said
    assert "SEVERAL_POSES_AGREE" in said
    assert "up_axis" in said
    assert "± 0.5 %" in page.locator("#figures").inner_text()


def test_what_the_imports_warned_of_is_told_beside_the_verdict(visit: Visit) -> None:
    page = visit.open("ambiguous")
    assert page.locator("#warnings li").all_inner_texts() == [f"Scene: {WARNING}"]


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
    assert page.locator("#matrix").inner_text() == matrix
    expect(page.locator("#iteration-text")).to_have_text("Result")


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


def test_deviations_are_the_documents(visit: Visit) -> None:
    page = visit.open("ambiguous")
    expect(page.locator("#certainty-words")).to_contain_text("If the pose is right, it is known: its center to ± ")
    shown = numbers(page.locator("#sigmas .mono:last-child").all_inner_texts())
    assert shown == [0.003, 0.001, 0.002, 0.4, 0.8, 0.2, 0.5]
    widths = [
        page.locator("#sigmas .track span").nth(k).evaluate("node => parseFloat(node.style.width)") for k in range(7)
    ]
    assert widths == pytest.approx([100, 100 / 3, 200 / 3, 40, 80, 20, 50], rel=1e-3)  # a degree, a per cent
    assert page.locator("#symmetry").inner_text().split("\n") == [
        "Symmetry of the object",
        "2 rotations about (0.00, 0.00, 1.00) look the same",
    ]


def test_the_covariance_stands_in_its_order(visit: Visit) -> None:
    page = visit.open("ambiguous")
    expect(page.locator("#covariance")).to_be_hidden()
    page.locator("#covariance-details summary").click()
    assert page.locator("#covariance thead th").all_inner_texts() == ORDERING
    assert page.locator("#covariance tbody th").all_inner_texts() == ORDERING
    cells = np.reshape(numbers([text.replace("e−", "e-") for text in cells_of(visit)]), (7, 7))
    np.testing.assert_allclose(cells.diagonal(), np.square(SIGMAS), rtol=0.05)
    assert cells[0, 3] == pytest.approx(0.3 * SIGMAS[0] * SIGMAS[3], rel=0.05)
    assert cells[0, 1] == 0


def cells_of(visit: Visit) -> list[str]:
    return visit.page.locator("#covariance tbody td").all_inner_texts()


def test_the_options_that_were_used_are_shown(visit: Visit) -> None:
    page = visit.open("ambiguous")
    assert page.locator("#preset").inner_text() == "preset robust"
    page.locator("#options summary").click()
    assert page.locator("#option-groups div").all_inner_texts() == [
        "rotations\n600",
        "inlier_distance\n0.015",
    ]


def test_a_search_shows_its_ranking(visit: Visit) -> None:
    page = visit.open("searched")
    assert page.locator("#ranking-note").inner_text() == "12 candidates"
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
    assert page.locator("#up").input_value() == "y"
    tipped = canvas_pixels(page)
    page.locator("#up").select_option("z")
    assert changed_share(tipped, canvas_pixels(page)) > 0.2


def test_results_that_know_nothing_of_all_this_are_shown_without(visit: Visit) -> None:
    page = visit.open("done")
    for card in ("ranking", "poses", "certainty", "options"):
        expect(page.locator(f"#{card}")).to_be_hidden()
    assert "Surfaces agree" in page.locator("#verdict-reason").inner_text()


@pytest.mark.usefixtures("own_page")
def test_without_a_view_the_alternatives_still_have_their_numbers(visit: Visit) -> None:
    visit.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = visit.open("ambiguous")
    matrix = page.locator("#matrix").inner_text()
    page.locator("#pose-list label", has_text="180 degrees about x").click()
    expect(page.locator("#transform-note")).to_have_text("An alternative: 180 degrees about x")
    assert page.locator("#matrix").inner_text() != matrix


def test_alternatives_can_be_chosen_by_keyboard(visit: Visit) -> None:
    page = visit.open("ambiguous")
    page.locator("#pose-list input").first.focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#pose-list input").nth(1)).to_be_checked()
    expect(page.locator("#transform-note")).to_have_text("An alternative: 172 degrees about z")
