"""Densities against the slow formulas, and depths against integrals that are solved by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.importing.radiance.density import RadianceField, fused_layers, plain_levels, tiny_levels
from regnf_core.importing.radiance.depths import depth_images, sampled
from regnf_core.importing.splats.drawing import Camera
from regnf_core.schema.hash_grid_config import HashGridConfig
from tests.core.importing.radiance.fitted import Doubles, Fitted, Floats, Grid, Network

RANDOM = np.random.default_rng(7)


def field_of(fitted: Fitted, low: float = 0.0, high: float = 1.0, contracted: bool = False) -> RadianceField:
    grid, network = fitted.grid, fitted.network
    corners = np.full(3, low), np.full(3, high)
    if not grid.tiny:
        levels = plain_levels(grid.base, grid.top, fitted.table, grid.levels)
        layers = ((network.first, network.first_bias), (network.last[:1], network.last_bias[:1]))
        return RadianceField(levels, layers, *corners, contracted, 0.5, 0.0)
    config = HashGridConfig.from_top_resolution(
        grid.top,
        levels=grid.levels,
        features_per_level=grid.features,
        log2_table_size=grid.log2,
        base_resolution=grid.base,
    ).with_entry_count(grid.rows)
    layers = fused_layers(fitted.flat()[: -fitted.table.size], grid.levels * grid.features, 1)
    return RadianceField(tiny_levels(config, fitted.table.ravel()), layers, *corners, contracted, 0.5, 0.0)


def random_field(tiny: bool, features: int = 2) -> Fitted:
    """Features of any size: every row and column counts."""
    grid = Grid(tiny, levels=16 // features, features=features, log2=12, base=8, top=220)
    table = RANDOM.normal(size=(grid.rows, features)).astype(np.float32)
    return Fitted(grid, Network.random(16, biased=not tiny), table)


@pytest.mark.parametrize(("tiny", "features"), [(True, 2), (True, 4), (True, 8), (True, 1), (False, 2), (False, 4)])
def test_the_density_is_that_of_the_formulas(tiny: bool, features: int) -> None:
    fitted = random_field(tiny, features)
    points = RANDOM.uniform(0.001, 0.999, (3000, 3))
    found = field_of(fitted).density(points)
    np.testing.assert_allclose(np.log(found), math.log(0.5) + fitted.exponent(points), atol=2e-3)


def test_space_is_contracted_by_the_largest_coordinate() -> None:
    """1 / (2 - 1 / 4) of a place is left at a distance of 4."""
    fitted = random_field(True)
    field = field_of(fitted, -2.0, 2.0, contracted=True)
    points = np.array([[0.3, -0.9, 0.2], [4.0, 2.0, -1.0], [0.5, -10.0, 3.0]])
    inner = np.array([[0.3, -0.9, 0.2], [1.75, 0.875, -0.4375], [0.095, -1.9, 0.57]])
    wanted = math.log(0.5) + fitted.exponent((inner + 2.0) / 4.0)
    np.testing.assert_allclose(np.log(field.density(points)), wanted, atol=2e-3)


def test_outside_of_the_box_is_nothing() -> None:
    field = field_of(random_field(False), -1.0, 1.0)
    assert (field.density(np.array([[1.01, 0.0, 0.0], [0.0, -3.0, 0.0], [0.0, 0.0, 1.0]])) == 0.0).all()
    assert field.density(np.array([[0.99, 0.0, 0.0]]))[0] > 0.0


def test_the_levels_of_plain_pytorch_are_rounded_as_there() -> None:
    """Its own expression, of the trainer's defaults; the finest level has 2047 cells, not 2048."""
    growth = np.exp((np.log(2048) - np.log(16)) / 15)
    wanted = torch.floor(16 * growth ** torch.arange(16))
    levels = plain_levels(16, 2048, np.zeros((16 * 8, 2), np.float32), 16)
    assert [level.scale for level in levels] == wanted.tolist()
    assert levels[-1].scale == 2047.0


def test_fused_layers_need_their_very_number() -> None:
    first, hidden, last = (RANDOM.normal(size=shape).astype(np.float32) for shape in ((64, 32), (64, 64), (16, 64)))
    flat = np.concatenate([first.ravel(), hidden.ravel(), last.ravel()])
    layers = fused_layers(flat, 32, 2)
    for (found, bias), wanted in zip(layers, (first, hidden, last[:1]), strict=True):
        np.testing.assert_array_equal(found, wanted)
        assert not bias.any()
    for wrong, hidden_layers in ((flat[:-1], 2), (flat, 1), (flat, 0), (flat, 9)):
        with pytest.raises(FieldFormatError) as caught:
            fused_layers(wrong, 32, hidden_layers)
        assert caught.value.reason == "TENSOR_SHAPE"


class Solid:
    """A density that is known: of a half space x > 0, a slab before it, or fog."""

    def __init__(self, behind: float, slab: float = 0.0, fog: float = 0.0) -> None:
        self.behind, self.slab, self.fog = behind, slab, fog

    def density(self, points: Doubles) -> Floats:
        x = points[:, 0]
        slab = self.slab * ((x > -0.3) & (x < -0.2))
        return (self.fog + self.behind * (x > 0.0) + slab).astype(np.float32)


LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)
AHEAD = Camera(
    np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.75], [0.0, 0.0, 0.0, 1.0]]),
    (40.0, 40.0),
    (16.0, 16.0),
    (32, 32),
)
"""At x = -0.75, along x."""


def seen(solid: Solid, near: float = 0.0) -> Floats:
    lattice = sampled(solid, LOW, HIGH, 128, 2)  # type: ignore[arg-type]
    return depth_images(lattice, [AHEAD], near, 2)[0]


def test_half_of_the_light_is_stopped_by_a_known_thickness() -> None:
    """log 2 / 20 along the ray: at 0.75 and that, times the cosine beside the middle."""
    depth = seen(Solid(20.0))
    row, column = np.indices(depth.shape) + 0.5
    cosine = 1.0 / np.sqrt(1.0 + ((row - 16.0) / 40.0) ** 2 + ((column - 16.0) / 40.0) ** 2)
    assert np.abs(depth - (0.75 + cosine * math.log(2.0) / 20.0)).max() < 0.6 * 2.0 / 128


def test_a_thin_sheet_that_stops_less_than_half_is_looked_through() -> None:
    """A slab of 0.1: 6 stop 45 % on straight rays, and 8 stop 55 %."""
    assert seen(Solid(400.0, slab=6.0))[15:17, 15:17] == pytest.approx(0.75, abs=0.016)
    assert seen(Solid(400.0, slab=8.0))[15:17, 15:17] == pytest.approx(0.45 + math.log(2.0) / 8.0, abs=0.016)


def test_fog_stops_light_too_but_not_before_the_nearest_plane() -> None:
    straight = seen(Solid(0.0, fog=1.0))[15:17, 15:17]
    assert straight == pytest.approx(math.log(2.0), abs=0.016)
    assert seen(Solid(0.0, fog=1.0), near=0.5)[15:17, 15:17] == pytest.approx(0.5 + math.log(2.0), abs=0.02)
    assert not seen(Solid(0.0, fog=0.3)).any()


def test_what_is_no_number_is_free() -> None:
    class Broken(Solid):
        def density(self, points: Doubles) -> Floats:
            return np.where(points[:, 0] < -0.5, np.float32(np.nan), np.float32(np.inf) * (points[:, 0] > 0.0)).astype(
                np.float32
            )

    assert np.abs(seen(Broken(0.0)) - 0.75).max() < 0.03
