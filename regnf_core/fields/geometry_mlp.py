"""The small network that turns a point's features into its signed distance, and its derivative in closed form."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from regnf_core.fields.activations import ACTIVATIONS
from regnf_core.schema.layers import count_layers


class GeometryMlp:
    """Linear layers with an activation between; where there are more than ``skip_at``, that one sees the input again.

    weights[i]: (out_i, in_i), biases[i]: (out_i,), weight normalization already folded in. Of the last layer only the
    first row is evaluated: the signed distance. The skip connection feeds [h, input] / sqrt 2; skip_at None: there is
    none. activation: "softplus" (of 100 a, over 100), "relu" or "sine".
    """

    def __init__(
        self,
        weights: Sequence[Tensor],
        biases: Sequence[Tensor],
        skip_at: int | None = 4,
        activation: str = "softplus",
    ) -> None:
        self.weights = [*weights[:-1], weights[-1][:1]]
        self.biases = [*biases[:-1], biases[-1][:1]]
        self.skip_at = skip_at if skip_at is not None and len(self.weights) > skip_at else None
        self.activation = activation
        self._function = ACTIVATIONS[activation]

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], skip_at: int | None = None, activation: str = "relu"
    ) -> GeometryMlp:
        """The network in the tensors ``layers.{i}.weight`` and ``layers.{i}.bias`` of a stored field, in float32."""
        layers = range(count_layers(tensors))
        weights, biases = ([tensors[f"layers.{i}.{part}"].float() for i in layers] for part in ("weight", "bias"))
        return cls(weights, biases, skip_at, activation)

    def to(self, device: torch.device | str) -> GeometryMlp:
        """The same network on another device."""
        weights, biases = ([t.to(device) for t in tensors] for tensors in (self.weights, self.biases))
        return GeometryMlp(weights, biases, self.skip_at, self.activation)

    def __call__(self, features: Tensor) -> Tensor:
        """Signed distance (N,) of features (N, in)."""
        return self._linear(len(self.weights) - 1, self.hidden(features), features).squeeze(-1)

    def hidden(self, features: Tensor) -> Tensor:
        """What the last layer is fed (N, width), of features (N, in)."""
        h = features
        for layer in range(len(self.weights) - 1):
            h = self._function.value(self._linear(layer, h, features))
        return h

    def with_gradient(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) of features (N, in) and its gradient (N, in) by them, by reverse accumulation."""
        h, slopes = self._forward(features)
        distance = self._linear(len(self.weights) - 1, h, features).squeeze(-1)
        return distance, self._gradient(slopes, features)

    def last_inputs_and_gradient(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """What the last layer multiplies (N, its columns), of features (N, in), and the distance's gradient (N, in)."""
        h, slopes = self._forward(features)
        return self._with_skip(len(self.weights) - 1, h, features), self._gradient(slopes, features)

    def _forward(self, features: Tensor) -> tuple[Tensor, list[Tensor]]:
        """What the last layer is fed (N, width), and the slopes of the activations before it."""
        h, slopes = features, []
        for layer in range(len(self.weights) - 1):
            a = self._linear(layer, h, features)
            slopes.append(self._function.slope(a))
            h = self._function.value(a)
        return h, slopes

    def _gradient(self, slopes: list[Tensor], features: Tensor) -> Tensor:
        """Of the distance, by the features (N, in)."""
        gradient = self.weights[-1].expand(features.shape[0], -1)
        skipped = None
        if self.skip_at == len(self.weights) - 1:
            gradient, skipped = self._split_skip(gradient, features)
        for layer in reversed(range(len(self.weights) - 1)):
            gradient = (gradient * slopes[layer]) @ self.weights[layer]
            if layer == self.skip_at:
                gradient, skipped = self._split_skip(gradient, features)
        return gradient if skipped is None else gradient + skipped

    def _linear(self, layer: int, h: Tensor, features: Tensor) -> Tensor:
        return torch.addmm(self.biases[layer], self._with_skip(layer, h, features), self.weights[layer].T)

    def _with_skip(self, layer: int, h: Tensor, features: Tensor) -> Tensor:
        return torch.cat((h, features), dim=-1) / math.sqrt(2.0) if layer == self.skip_at else h

    @staticmethod
    def _split_skip(gradient: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        gradient = gradient / math.sqrt(2.0)
        split = gradient.shape[1] - features.shape[1]
        return gradient[:, :split], gradient[:, split:]
