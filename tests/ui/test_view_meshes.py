"""The page of a finished job whose fields have display meshes: what is drawn as a mesh, and the samples as a choice."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.ui.conftest import Visit
from tests.ui.pixels import canvas_pixels, changed_share, colored, overlap

pytestmark = pytest.mark.browser


def hide(visit: Visit, layer: str) -> None:
    visit.page.locator(f"label.chip[data-layer={layer}]").click()


def test_meshes_are_drawn_where_the_samples_lie(visit: Visit) -> None:
    page = visit.open("meshed")
    expect(page.locator("#surfaces")).to_have_value("meshes")
    expect(page.locator("#size-dial")).to_be_hidden()
    hide(visit, "before")
    hide(visit, "box")
    mesh = colored(canvas_pixels(page), "blue")
    page.locator("#surfaces").select_option("discs")
    expect(page.locator("#size-dial")).to_be_visible()
    samples = colored(canvas_pixels(page), "blue")
    assert mesh.mean() > 0.02
    assert overlap(mesh, samples) > 0.6
    assert changed_share(mesh[..., None] * 255, samples[..., None] * 255) > 0.001
    assert visit.complaints == []


def test_every_mesh_is_a_layer(visit: Visit) -> None:
    """It moves with the iterations, and what is hidden stays hidden as samples."""
    page = visit.open("meshed")
    shown = canvas_pixels(page)
    for layer, least in (("scene", 0.002), ("context", 0.05), ("before", 0.005), ("after", 0.005)):
        hide(visit, layer)
        assert changed_share(shown, canvas_pixels(page)) > least, layer
        hide(visit, layer)
        assert changed_share(shown, canvas_pixels(page)) < 0.001, layer
    hide(visit, "before")
    end = colored(canvas_pixels(page), "blue")
    page.locator("#iteration").fill("0")
    assert overlap(end, colored(canvas_pixels(page), "blue")) < 0.5
    hide(visit, "after")
    page.locator("#surfaces").select_option("discs")
    assert colored(canvas_pixels(page), "blue").mean() < 0.001
    hide(visit, "after")
    assert colored(canvas_pixels(page), "blue").mean() > 0.01


def test_without_meshes_there_is_no_choice(visit: Visit) -> None:
    page = visit.open("done")
    expect(page.locator("#surfaces-dial")).to_be_hidden()
    assert [url for url in visit.requests if "mesh.glb" in url] == []


def test_a_mesh_that_is_gone_leaves_the_samples(visit: Visit) -> None:
    visit.page.route("**/mesh.glb*", lambda route: route.fulfill(status=404, json={"reason": "FIELD_VIEW_NOT_FOUND"}))
    page = visit.open("meshed")
    expect(page.locator("#surfaces-dial")).to_be_hidden()
    assert colored(canvas_pixels(page), "blue").mean() > 0.01
