"""Sines and cosines of a position: directions off the axes, and derivatives."""

from __future__ import annotations

import math

import pytest
import torch

from regnf_core.fields.color_head import PositionalEncoding


def test_the_directions_off_the_axes_are_those_of_an_icosahedron() -> None:
    """Its twelve corners are (0, 1, g) and its turns, g the golden ratio; edges join corners 2 apart."""
    golden = (1 + math.sqrt(5)) / 2
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    corners = torch.tensor([p for a, b in signs for p in ((0, a, b * golden), (a, b * golden, 0), (b * golden, 0, a))])
    pairs = torch.combinations(torch.arange(12))
    edges = corners[pairs][(corners[pairs].diff(dim=1).norm(dim=-1) - 2).abs()[:, 0] < 1e-6].mean(dim=1)
    expected = torch.nn.functional.normalize(torch.cat((corners, edges)), dim=-1)  # (42, 3)
    directions = PositionalEncoding.directions(expected)
    both = torch.cat((directions, -directions))
    distance = torch.cdist(expected, both, compute_mode="donot_use_mm_for_euclid_dist").min(dim=1)
    assert float(distance.values.max()) < 1e-6
    assert sorted(distance.indices.tolist()) == list(range(42))


def test_an_encoding_off_the_axes_by_hand() -> None:
    point = torch.tensor([[0.1, -0.2, 0.3]])
    encoding = PositionalEncoding(degree=2, base_frequency=0.5, off_axis=True)
    encoded = encoding.encode(point)[0]
    assert encoded.shape == (encoding.width,) == (84,)
    length = 0.1 * 0.8506508 + 0.3 * 0.5257311  # along the first direction
    torch.testing.assert_close(encoded[:2], torch.tensor([math.sin(0.5 * length), math.sin(length)]))
    torch.testing.assert_close(encoded[42:44], torch.tensor([math.cos(0.5 * length), math.cos(length)]))
    torch.testing.assert_close(encoded[2 * 17 + 1], torch.tensor(math.sin(0.3)))  # the eighteenth is z


@pytest.mark.parametrize("frequency", [1.0, 2.0 * math.pi])
@pytest.mark.parametrize("off_axis", [False, True])
def test_positional_encoding_gradient_agrees_with_autograd(frequency: float, off_axis: bool) -> None:
    encoding = PositionalEncoding(4, frequency, off_axis)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=generator).double().requires_grad_()
    weights = torch.randn(50, encoding.width, generator=generator).double()
    encoded = encoding.encode(points)
    (expected,) = torch.autograd.grad((encoded * weights).sum(), points)
    torch.testing.assert_close(encoding.pull_back(encoded.detach(), weights), expected)
