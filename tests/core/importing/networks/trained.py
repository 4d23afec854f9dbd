"""Small networks of each family, as torch modules with the trainers' names, trained for a moment."""

from __future__ import annotations

import math
from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor, nn

State = OrderedDict[str, Tensor]


class Implicit(nn.Module):
    """NeuS's, with the geometric initialization."""

    def __init__(
        self,
        rng: np.random.Generator,
        degree: int,
        hidden: int,
        layers: int,
        skips: tuple[int, ...],
        scale: float = 1.0,
        results: int = 1,
        radius: float = 0.5,
    ) -> None:
        super().__init__()
        self.degree, self.scale, self.skips, self.count = degree, scale, skips, layers
        width = 3 + 6 * degree
        generator = torch.Generator().manual_seed(int(rng.integers(1 << 30)))
        columns = width
        for i in range(layers):
            rows = results if i == layers - 1 else hidden - width if i + 1 in skips else hidden
            layer = nn.Linear(columns, rows)
            with torch.no_grad():
                if i == layers - 1:
                    layer.weight.normal_(math.sqrt(math.pi) / math.sqrt(columns), 1e-4, generator=generator)
                    layer.bias.fill_(-radius)
                else:
                    layer.bias.zero_()
                    layer.weight.normal_(0.0, math.sqrt(2.0) / math.sqrt(rows), generator=generator)
                    if degree and i == 0:
                        layer.weight[:, 3:] = 0.0
                    elif degree and i in skips:
                        layer.weight[:, -(width - 3) :] = 0.0
            setattr(self, f"lin{i}", layer)
            columns = hidden
        self.activation = nn.Softplus(beta=100)

    def forward(self, x: Tensor) -> Tensor:
        x = x * self.scale
        parts = [x] + [wave(2.0**k * x) for k in range(self.degree) for wave in (torch.sin, torch.cos)]
        given = h = torch.cat(parts, dim=-1)
        for i in range(self.count):
            if i in self.skips:
                h = torch.cat((h, given), dim=-1) / math.sqrt(2.0)
            h = getattr(self, f"lin{i}")(h)
            if i < self.count - 1:
                h = self.activation(h)
        return h[:, 0] / self.scale


class Decoder(nn.Module):
    """DeepSDF's: [latent, xyz], ReLU, the input again at ``latent_in``, one tanh or two at the end."""

    def __init__(
        self,
        rng: np.random.Generator,
        latent: int,
        hidden: int,
        layers: int,
        latent_in: tuple[int, ...],
        xyz_in_all: bool,
        norms: bool,
        use_tanh: bool,
    ) -> None:
        super().__init__()
        self.count, self.latent_in, self.xyz_in_all, self.use_tanh = layers, latent_in, xyz_in_all, use_tanh
        torch.manual_seed(int(rng.integers(1 << 30)))
        self.code = torch.randn(latent) * 0.3
        for i in range(layers):
            last = i == layers - 1
            columns = latent + 3 if i == 0 else hidden
            rows = 1 if last else hidden
            if i + 1 in latent_in:
                rows -= latent + 3
            elif xyz_in_all and not last:
                rows -= 3
            setattr(self, f"lin{i}", nn.Linear(columns, rows))
            if norms and not last:
                setattr(self, f"bn{i}", nn.LayerNorm(rows))

    def forward(self, x: Tensor) -> Tensor:
        given = h = torch.cat((self.code.expand(len(x), -1), x), dim=-1)
        for i in range(self.count):
            if i in self.latent_in:
                h = torch.cat((h, given), dim=-1)
            elif i and self.xyz_in_all:
                h = torch.cat((h, x), dim=-1)
            h = getattr(self, f"lin{i}")(h)
            if i < self.count - 1:
                if hasattr(self, f"bn{i}"):
                    h = getattr(self, f"bn{i}")(h)
                h = torch.relu(h)
        h = torch.tanh(h[:, 0])
        return torch.tanh(h) if self.use_tanh else h


class Sines(nn.Module):
    """SIREN."""

    def __init__(self, rng: np.random.Generator, hidden: int, layers: int, omega: float, first: float | None) -> None:
        super().__init__()
        torch.manual_seed(int(rng.integers(1 << 30)))
        self.omega, self.first, self.count = omega, omega if first is None else first, layers
        blocks = []
        for i in range(layers):
            layer = nn.Linear(3 if i == 0 else hidden, 1 if i == layers - 1 else hidden)
            limit = 1 / 3 if i == 0 else math.sqrt(6.0 / hidden) / omega
            nn.init.uniform_(layer.weight, -limit, limit)
            blocks.append(nn.Sequential(layer))
        self.net = nn.Sequential(*blocks)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.sin(self.first * self.net[0](x))
        for i in range(1, self.count - 1):
            h = torch.sin(self.omega * self.net[i](h))
        value: Tensor = self.net[self.count - 1](h)[:, 0]
        return value


def split(state: dict[str, Tensor], names: list[str]) -> State:
    """The same state with the weights of these layers as direction (of another length) and length."""
    made = State()
    for name, value in state.items():
        layer, _, part = name.rpartition(".")
        if part == "weight" and layer in names:
            made[f"{layer}.weight_g"] = value.norm(dim=1, keepdim=True)
            made[f"{layer}.weight_v"] = 1.3 * value
        else:
            made[name] = value
    return made
