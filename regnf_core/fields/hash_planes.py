"""The hash encoding of points within its cube, without a graph: each feature is a plane, one long row of all points.

The same features as :class:`regnf_core.fields.hash_encoding.HashEncoding` gives, to the last digit. Indices are 32 bits
wide and no axis is short, so that every step runs in the processor's vector units.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.hash_encoding import HashEncoding, lower_32_bits

_SIGN = 31
"""The bit that tells negative 32-bit numbers."""


@dataclass(frozen=True, eq=False)
class EncodedPlanes:
    """features: (F, A, N) of A levels · derivatives: (3, F, A, N) by the weights towards the upper corner · slopes: of
    these weights by the point, (3, A, N) or what broadcasts to it."""

    features: Tensor
    derivatives: Tensor
    slopes: Tensor

    def pull_back(self, gradient: Tensor) -> Tensor:
        """Gradient (3, N) by the point in the unit cube, from that by the features (F, A, N)."""
        by_weight = self.derivatives[:, 0] * gradient[0]
        for feature in range(1, len(gradient)):
            by_weight.addcmul_(self.derivatives[:, feature], gradient[feature])
        return sum_of_planes(by_weight.mul_(self.slopes))


class HashPlanes:
    """Evaluates a :class:`HashEncoding` at points of the unit cube, as its table is at that moment."""

    def __init__(self, encoding: HashEncoding) -> None:
        width = encoding.config.features_per_level
        self._encoding = encoding
        # Rows become places in the flat table: all numbers are multiplied by the features of a row, before they wrap.
        self._strides = lower_32_bits(encoding.strides * width)
        self._entries = (encoding.entries * width).int()
        self._offsets = (encoding.offsets * width).int()

    @staticmethod
    def can(encoding: HashEncoding) -> bool:
        """Whether places in the table have 31 bits, its rows are a power of two wide, and no dense level is passed by
        more than once around."""
        width, dense = encoding.config.features_per_level, encoding.dense_levels
        last = (encoding.scales[:dense] + 0.5).floor().long() + 1
        farthest = last * encoding.strides[:, :dense, 0].sum(0)
        around = bool((farthest < 2 * encoding.entries[:dense, 0]).all())
        return around and encoding.table.numel() < 2**_SIGN and width & (width - 1) == 0

    def features(self, unit_points: Tensor) -> Tensor:
        """Features (F, A, N) at ``unit_points`` (3, N)."""
        weights, _, rows = self._locate(unit_points)
        values = self._gather(rows)
        for weight in weights:
            values = torch.lerp(values[:, 0], values[:, 1], weight)
        return values

    def with_derivatives(self, unit_points: Tensor) -> EncodedPlanes:
        """The features at ``unit_points`` (3, N), and what their gradient is made of."""
        weights, slopes, rows = self._locate(unit_points)
        values = self._gather(rows)
        derivatives: list[Tensor] = []
        for weight in weights:
            derivatives = [torch.lerp(d[:, 0], d[:, 1], weight) for d in derivatives]
            derivatives.append(values[:, 1] - values[:, 0])
            values = torch.lerp(values[:, 0], values[:, 1], weight)
        return EncodedPlanes(values, torch.stack(derivatives), slopes)

    def _locate(self, unit_points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weights towards the upper corners (3, A, N), their slopes, and the corners' places (2, 2, 2, A, N)."""
        cell, weights, slopes = self._encoding.cells(unit_points)
        lower = cell.int().mul_(self._strides)
        both = torch.stack((lower, lower + self._strides), dim=1)  # (3, 2, A, N)
        x, y, z = both[0][:, None, None], both[1][None, :, None], both[2][None, None, :]
        d = self._encoding.dense_levels
        rows = torch.empty(2, 2, 2, *cell.shape[1:], dtype=torch.int32)
        dense, hashed = rows[..., :d, :], rows[..., d:, :]
        # At the cube's upper border a dense level's sum passes its entries, by less than their number: once around.
        torch.add(x[..., :d, :], y[..., :d, :] + z[..., :d, :], out=dense)
        dense.sub_(self._entries[:d])
        dense.add_((dense >> _SIGN).bitwise_and_(self._entries[:d]))
        torch.bitwise_xor(x[..., d:, :], y[..., d:, :] ^ z[..., d:, :], out=hashed)
        hashed.bitwise_and_(self._entries[d:] - 1)
        return weights, slopes, rows.add_(self._offsets)

    def _gather(self, rows: Tensor) -> Tensor:
        """Values (F, 2, 2, 2, A, N) at places (2, 2, 2, A, N), which are used up."""
        values = torch.empty(self._encoding.config.features_per_level, *rows.shape)
        places, flat = rows.view(-1), self._encoding.table.detach().reshape(-1)
        for feature, plane in enumerate(values):
            torch.index_select(flat, 0, places if feature == 0 else places.add_(1), out=plane.view(-1))
        return values


def planes_of(encoding: HashEncoding) -> HashPlanes | None:
    """The faster evaluation without a graph, on the CPU; None for a grid that it does not suit."""
    return HashPlanes(encoding) if encoding.table.device.type == "cpu" and HashPlanes.can(encoding) else None


def sum_of_planes(planes: Tensor) -> Tensor:
    """(3, N), the sum of planes (3, A, N), in the same order for each point, however many there are."""
    total = planes[:, 0]
    for number in range(1, planes.shape[1]):
        total.add_(planes[:, number])
    return total
