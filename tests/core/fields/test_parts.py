"""The small parts of a field: contraction, sines and cosines, the network."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.neus_facto_function import GeometryMlp, contract_linf, pull_back_linf


def test_contraction_by_hand() -> None:
    points = torch.tensor([[0.5, -0.9, 0.1], [2.0, 0.0, -1.0], [-4.0, 4.0, 1.0], [1.0, 0.5, 0.0]])
    # |x|_inf = 2: factor (2 - 1/2) / 2 = 3/4. |x|_inf = 4: factor (2 - 1/4) / 4 = 7/16.
    expected = torch.tensor([[0.5, -0.9, 0.1], [1.5, 0.0, -0.75], [-1.75, 1.75, 0.4375], [1.0, 0.5, 0.0]])
    torch.testing.assert_close(contract_linf(points), expected)


def test_contraction_gradient_agrees_with_autograd() -> None:
    generator = torch.Generator().manual_seed(0)
    points = (3.0 * torch.randn(200, 3, generator=generator)).double().requires_grad_()
    weights = torch.randn(200, 3, generator=generator).double()
    (expected,) = torch.autograd.grad((contract_linf(points) * weights).sum(), points)
    torch.testing.assert_close(pull_back_linf(points.detach(), weights), expected)


def test_positional_encoding_by_hand() -> None:
    encoded = PositionalEncoding(degree=2).encode(torch.tensor([[0.1, 0.2, 0.3]]))
    angles = [0.1, 0.2, 0.2, 0.4, 0.3, 0.6]
    torch.testing.assert_close(encoded[0], torch.tensor([*map(math.sin, angles), *map(math.cos, angles)]))


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


def plain_network(weights: list[Tensor], biases: list[Tensor], features: Tensor) -> Tensor:
    h = features
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if i == 4:
            h = torch.cat((h, features), dim=-1) / math.sqrt(2.0)
        h = h @ weight.T + bias
        if i < len(weights) - 1:
            h = torch.nn.functional.softplus(h, beta=100.0)
    return h[:, 0]


@pytest.mark.parametrize("layers", [1, 2, 3, 4, 5, 6, 9])
def test_network_agrees_with_autograd(layers: int) -> None:
    generator = torch.Generator().manual_seed(layers)
    weights, biases, columns = [], [], 7
    for i in range(layers):
        columns += 7 if i == 4 else 0
        rows = 3 if i == layers - 1 else 10 + i
        weights.append(torch.randn(rows, columns, generator=generator) / math.sqrt(columns))
        biases.append(0.1 * torch.randn(rows, generator=generator))
        columns = rows
    features = torch.randn(64, 7, generator=generator).requires_grad_()
    expected = plain_network(weights, biases, features)
    (slope,) = torch.autograd.grad(expected.sum(), features)
    network = GeometryMlp(weights, biases)
    distance, gradient = network.with_gradient(features.detach())
    torch.testing.assert_close(distance, expected.detach(), rtol=0, atol=2e-6)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-5)
    torch.testing.assert_close(network(features.detach()), distance)
