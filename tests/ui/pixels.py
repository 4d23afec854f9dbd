"""Looking at the page's canvas: its pixels as the reader sees them."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import FloatRect, Page

Pixels = NDArray[np.int16]
Mask = NDArray[np.bool_]


def box_of(page: Page, selector: str = "#canvas") -> FloatRect:
    """Where an element is."""
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box


def canvas_pixels(page: Page) -> Pixels:
    """(H, W, 3) of the middle of the canvas, where nothing lies over it, two drawn frames after the last change."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = box_of(page)
    width, height = box["width"], box["height"]
    clip: FloatRect = {
        "x": box["x"] + width * 0.1, "y": box["y"] + height * 0.2, "width": width * 0.8, "height": height * 0.6,
    }  # fmt: skip
    picture = Image.open(io.BytesIO(page.screenshot(clip=clip)))
    return np.asarray(picture.convert("RGB"), dtype=np.int16)


def changed_share(before: Pixels, after: Pixels) -> float:
    """The share of pixels that differ visibly."""
    return float(differs(before, after).mean())


def differs(before: Pixels, after: Pixels) -> Mask:
    """(H, W): which pixels differ visibly."""
    marked: Mask = np.abs(before - after).max(axis=-1) > 12
    return marked


def overlap(one: Mask, other: Mask) -> float:
    """Shared pixels over all pixels of both."""
    return float((one & other).sum() / (one | other).sum())


def blue(page: Page) -> Mask:
    """(H, W): which pixels show the object after."""
    pixels = canvas_pixels(page)
    return pixels[..., 2] - pixels[..., 0] > 70


def orange(page: Page) -> Mask:
    """(H, W): which pixels show the object before."""
    pixels = canvas_pixels(page)
    return pixels[..., 0] - pixels[..., 2] > 25
