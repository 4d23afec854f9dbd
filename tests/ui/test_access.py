"""The page for everyone: keyboard, screen reader, phone, dark and light, a strict content security policy."""

from __future__ import annotations

from typing import Any

import pytest

from tests.ui.conftest import Visit
from tests.ui.pixels import canvas_pixels, colored

pytestmark = pytest.mark.browser


def focused(visit: Visit) -> str:
    """The focused element's id, class, layer or tag, whichever it has first."""
    script = """() => {
      const node = document.activeElement;
      return node.id || node.className || node.dataset.layer || node.tagName;
    }"""
    return str(visit.page.evaluate(script))


def test_tab_visits_the_controls_in_reading_order_and_focus_can_be_seen(visit: Visit) -> None:
    page = visit.open("done")
    order = []
    for _ in range(26):
        page.keyboard.press("Tab")
        order.append(focused(visit))
        if order[-1] == "canvas":
            assert page.locator("#canvas").evaluate("node => getComputedStyle(node).outlineStyle") == "solid"
    wanted = ["skip", "brand", "copy-id", "canvas", "scene", "color", "up", "size", "frame-object", "play", "iteration"]
    places = [order.index(name) for name in wanted]
    assert places == sorted(places), order


def test_everything_has_a_name(visit: Visit) -> None:
    page = visit.open("done")
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('button, input, select, a[href], progress, canvas')]
            .filter((node) => node.checkVisibility() && !(node.getAttribute('aria-label') || node.labels?.length
              || node.textContent.trim() || node.querySelector('img[alt]:not([alt=""])')))
            .map((node) => node.outerHTML)"""
    )
    assert nameless == []
    assert page.locator("#status").get_attribute("aria-live") == "polite"
    assert page.locator("html").get_attribute("lang") == "en"
    ids = page.evaluate("() => [...document.querySelectorAll('[id]')].map((node) => node.id)")
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground(visit: Visit, scheme: Any) -> None:
    visit.page.emulate_media(color_scheme=scheme)
    page = visit.open("done")
    ratios = page.evaluate(
        """() => {
          const style = getComputedStyle(document.documentElement);
          const light = (name) => {
            const hex = style.getPropertyValue('--' + name).trim();
            const parts = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255)
              .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
            return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
          };
          const pairs = [['ink', 'surface'], ['ink', 'ground'], ['muted', 'surface'], ['muted', 'ground'],
            ['muted', 'raised'], ['muted', 'still-soft'], ['accent', 'surface'],
            ['on-accent', 'accent'], ['good', 'good-soft'],
            ['warn', 'warn-soft'], ['bad', 'bad-soft'], ['good', 'surface'], ['warn', 'surface'], ['bad', 'surface']];
          return pairs.map(([a, b]) => {
            const [high, low] = [light(a), light(b)].sort((x, y) => y - x);
            return [`${a} on ${b}`, (high + 0.05) / (low + 0.05)];
          });
        }"""
    )
    assert [(name, ratio) for name, ratio in ratios if ratio < 4.5] == []
    assert colored(canvas_pixels(page), "blue").mean() > 0.01


@pytest.fixture
def phone(context_options: dict[str, Any]) -> None:
    context_options |= {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True}


@pytest.mark.usefixtures("phone")
def test_nothing_overflows_on_a_phone_and_touch_turns_the_view(visit: Visit) -> None:
    for story in ("ambiguous", "searched", "failed", "locked", "done"):
        page = visit.open(story)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, story
        spilling = page.evaluate(
            """() => [...document.body.querySelectorAll('*')].filter((node) => node.checkVisibility()
                && !node.closest('.unseen, .skip') && node.getBoundingClientRect().right > 361)
                .map((node) => node.outerHTML)"""
        )
        assert spilling == [], story
    assert colored(canvas_pixels(page), "blue").mean() > 0.005
    assert page.locator("#canvas").evaluate("node => getComputedStyle(node).touchAction") == "none"
