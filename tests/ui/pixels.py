"""Looking at the page's canvas: its pixels as the reader sees them."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import FloatRect, Page

Pixels = NDArray[np.int16]


def canvas_pixels(page: Page) -> Pixels:
    """(H, W, 3) of the middle of the canvas, where nothing lies over it, two drawn frames after the last change."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    clip: FloatRect = {
        "x": box["x"] + box["width"] * 0.1,
        "y": box["y"] + box["height"] * 0.2,
        "width": box["width"] * 0.8,
        "height": box["height"] * 0.6,
    }
    picture = Image.open(io.BytesIO(page.screenshot(clip=clip)))
    return np.asarray(picture.convert("RGB"), dtype=np.int16)


def changed_share(before: Pixels, after: Pixels) -> float:
    """The share of pixels that differ visibly."""
    return float(differs(before, after).mean())


def differs(before: Pixels, after: Pixels) -> NDArray[np.bool_]:
    """(H, W): which pixels differ visibly."""
    marked: NDArray[np.bool_] = np.abs(before - after).max(axis=-1) > 12
    return marked


def overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Shared pixels over all pixels of both."""
    return float((one & other).sum() / (one | other).sum())


def colored(pixels: Pixels, hue: str) -> NDArray[np.bool_]:
    """(H, W): which pixels show the object after (blue) or before (orange)."""
    red, blue = pixels[..., 0], pixels[..., 2]
    return blue - red > 70 if hue == "blue" else red - blue > 25


def center_of(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean row and column of the true pixels."""
    rows, columns = np.nonzero(mask)
    return float(rows.mean()), float(columns.mean())
