"""The small parts of a field: contraction, sines and cosines, the network."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.fields.contraction import contract_linf, pull_back_linf
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.positional_encoding import PositionalEncoding


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


@pytest.mark.parametrize("two_pi", [False, True])
def test_positional_encoding_gradient_agrees_with_autograd(two_pi: bool) -> None:
    encoding = PositionalEncoding.with_two_pi(4, two_pi)
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
