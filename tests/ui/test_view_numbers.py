"""The page of a finished job: its numbers, and what its fields are called."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.fixture_server import WEB
from tests.ui.pixels import canvas_pixels, colored
from tests.ui.stories import LABELS, OPTIONS

pytestmark = pytest.mark.browser
ROOM, CHAIR = LABELS["a3"], LABELS["7c"]


def test_numbers_are_the_documents(visit: Visit) -> None:
    page = visit.open("done")
    result = visit.server.stage.data.result
    expect(page.locator("#verdict-word")).to_have_text("Registered")
    expect(page.locator("#verdict-reason")).to_contain_text("SURFACES_AGREE")
    cells = [float(text.replace("−", "-")) for text in page.locator("#matrix td").all_inner_texts()]
    assert np.allclose(np.reshape(cells, (4, 4)), result["T_scene_object"]["matrix"], atol=5.1e-6)
    before = page.locator("#matrix").inner_text()
    page.locator("input[name=direction][value=T_object_scene]").check(force=True)
    expect(page.locator("#matrix")).not_to_have_text(before, use_inner_text=True)
    cells = [float(text.replace("−", "-")) for text in page.locator("#matrix td").all_inner_texts()]
    assert np.allclose(np.reshape(cells, (4, 4)), result["T_object_scene"]["matrix"], atol=5.1e-6)
    for figure in ("1.6000", "93.1 %", "0.41 %", "12.3 s", "14.0 s"):  # created 20:26:40, finished 20:26:54
        expect(page.locator("#figures")).to_contain_text(figure)
    expect(page.locator("#time-total")).to_have_text("12.3 s of 14.0 s from request to result")
    about = json.loads((WEB / "metrics.json").read_text(encoding="utf-8"))
    said = page.locator("#agreement").inner_text()
    assert [n for n in result["metrics"] if not n.startswith("seconds") and about[n]["meaning"] not in said] == []
    assert page.locator("#shares").inner_text().split("\n")[:2] == ["Scene inliers", "96.2 %"]
    assert page.locator("#time-key li").count() == 6
    label = page.locator("#distance svg").get_attribute("aria-label")
    rows = json.loads(visit.server.stage.data.artifacts["trace.json"])
    end = (rows[-1]["residual_scene"] + 1.6 * rows[-1]["residual_object"]) / 2  # the latter is in the scene's units
    assert label is not None
    told = re.fullmatch(r"Mean distance over 40 iterations, from (\S+) to (\S+) object units", label)
    assert told is not None
    assert float(told[2]) == pytest.approx(end, rel=0.01)
    assert float(told[1]) > 5 * float(told[2])


def test_fields_are_called_by_their_names(visit: Visit) -> None:
    page = visit.open("done")
    expect(page.locator("#job-title")).to_have_text(f"{CHAIR} in {ROOM}")
    expect(page).to_have_title(f"{CHAIR} in {ROOM} – regnf")
    expect(page.locator("#job-facts")).to_contain_text(OPTIONS)
    assert any("7c" * 32 in url for url in visit.requests)
    assert not any(OPTIONS in url for url in visit.requests), "a digest, and not one of a field"
    expect(page.locator("#job-facts")).to_contain_text(ROOM)
    expect(page.locator("#job-facts")).to_contain_text(CHAIR)
    assert "a3" * 32 not in page.locator("body").inner_text()
    assert page.locator("#job-facts [title]").first.get_attribute("title") == "a3" * 32
    page.route("**/fields/*", lambda route: route.fulfill(status=404, json={"reason": "FIELD_NOT_FOUND"}))
    page.reload()
    expect(page.locator("#job-title")).to_have_text(f"{('7c' * 32)[:8]} in {('a3' * 32)[:8]}")


def test_a_field_without_a_label_is_called_by_the_one_in_its_file(visit: Visit) -> None:
    page = visit.open("labeled")
    expect(page.locator("#job-title")).to_have_text(f"stool in {ROOM}")


def test_the_curve_is_in_shares_of_the_diameter_where_that_is_known(visit: Visit) -> None:
    result = visit.server.stage.data.result
    metrics = result["metrics"] | {"object_diameter": 0.5}
    visit.page.route("**/result", lambda route: route.fulfill(status=200, json=result | {"metrics": metrics}))
    page = visit.open("done")
    expect(page.locator("#distance-note")).to_have_text("of the diameter")
    label = page.locator("#distance svg").get_attribute("aria-label") or ""
    end = json.loads(visit.server.stage.data.artifacts["trace.json"])[-1]
    told = float(label.removesuffix(" of the diameter").split()[-1])
    assert told == pytest.approx((end["residual_scene"] + 1.6 * end["residual_object"]) / 2 / 0.5, rel=0.01)


def test_matrix_is_copied_whole(visit: Visit) -> None:
    page = visit.page
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    visit.open("done")
    page.locator("#copy-matrix").click()
    expect(page.locator("#copy-matrix")).to_have_text("Copied")
    copied = json.loads(page.evaluate("navigator.clipboard.readText()"))
    assert np.allclose(copied, np.linalg.inv(visit.server.stage.data.T_object_scene), atol=1e-12)


def test_sparse_result_is_shown_without_trace_and_start(visit: Visit) -> None:
    page = visit.open("bare")
    assert colored(canvas_pixels(page), "blue").mean() > 0.01
    expect(page.locator("#timeline")).to_be_hidden()
    expect(page.locator("#before-chip")).to_be_hidden()
    expect(page.locator("#convergence")).to_be_hidden()
