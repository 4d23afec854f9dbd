"""The ellipsoid of the uncertainty in the view of a result."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from playwright.sync_api import expect

from regnf_core.geometry.sim3 import Sim3
from tests.ui.conftest import Visit
from tests.ui.pixels import canvas_pixels, changed_share

pytestmark = pytest.mark.browser
ELLIPSOID = """async ([covariance, center, shift, diameter]) => {
  const { ellipsoidOf, covarianceOfPlace } = await import('/static/js/ellipsoid.js');
  const found = ellipsoidOf(covariance, center, shift, diameter);
  return {
    spread: covarianceOfPlace(covariance, center, shift),
    factor: found?.factor ?? null,
    points: found ? [...found.object.geometry.getAttribute('position').array] : null,
  };
}"""


def random_covariance(seed: int, size: float) -> np.ndarray:
    half = np.random.default_rng(seed).normal(size=(7, 7)) * size
    return half @ half.T


def spread_of(covariance: np.ndarray, center: list[float], shift: list[float]) -> np.ndarray:
    """By finite differences of where a perturbed pose puts the point; the pose shifts by far more than the object's
    size, as the scene's origin may lie anywhere."""
    step = 1e-5
    T = Sim3.from_translation(torch.tensor(shift, dtype=torch.float64))

    def moved(i: int, by: float) -> np.ndarray:
        xi = torch.zeros(7, dtype=torch.float64)
        xi[i] = by
        placed = T[None].perturb(xi[None])[0].inverse().apply(torch.tensor([center], dtype=torch.float64))
        return np.asarray(placed[0])

    jacobian = np.stack([(moved(i, step) - moved(i, -step)) / (2 * step) for i in range(7)], axis=1)
    return jacobian @ covariance @ jacobian.T


@pytest.mark.parametrize(("seed", "size"), [(1, 0.004), (2, 0.2), (3, 1e-5)])
def test_every_point_lies_on_the_95_percent_surface(visit: Visit, seed: int, size: float) -> None:
    page = visit.open("done")
    covariance, center, shift = random_covariance(seed, size), [0.3, -0.2, 0.5], [4.0, -7.0, 2.0]
    found = page.evaluate(ELLIPSOID, [covariance.tolist(), center, shift, 1.0])
    expected = spread_of(covariance, center, shift)
    np.testing.assert_allclose(found["spread"], expected, rtol=1e-5, atol=1e-7 * expected.max())
    factor = found["factor"]
    away = (np.array(found["points"]).reshape(-1, 3) - center) / factor
    squares = np.einsum("ni,ij,nj->n", away, np.linalg.inv(expected), away)
    np.testing.assert_allclose(squares, 7.8147, rtol=2e-2)
    longest = math.sqrt(7.8147 * np.linalg.eigvalsh(expected).max()) * factor
    assert longest >= 0.1
    assert factor == 1 or longest < 1.0  # and is no larger than it must be


def test_without_a_number_there_is_none(visit: Visit) -> None:
    page = visit.open("done")
    covariance = random_covariance(1, 0.01).tolist()
    covariance[0][0] = None
    assert page.evaluate(ELLIPSOID, [covariance, [0, 0, 0], [0, 0, 0], 1.0])["factor"] is None
    assert page.evaluate(ELLIPSOID, [None, [0, 0, 0], [0, 0, 0], 1.0])["factor"] is None
    expect(page.locator("#uncertainty-chip")).to_be_hidden()


def test_it_is_drawn_when_it_is_asked_for(visit: Visit) -> None:
    page = visit.open("ambiguous")
    without = canvas_pixels(page)
    chip = page.locator("label.chip[data-layer=uncertainty]")
    expect(chip).to_contain_text("Uncertainty")
    chip.click()
    assert changed_share(without, canvas_pixels(page)) > 0.001
    chip.click()
    assert changed_share(without, canvas_pixels(page)) < 0.0005
    assert visit.complaints == []
