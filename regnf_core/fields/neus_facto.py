"""Fields of the neus-facto kind: hash encoding, sines and cosines and the point itself into a small network.

The function is that of sdfstudio's and nerfstudio's neus-facto, of NeuS (no grid) and of kin; a description says which.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.color_head import ColorHead, PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding, lower_32_bits
from regnf_core.fields.native.evaluator import native_evaluator
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction, pull_back_linf
from regnf_core.fields.user_fields import Evaluator, FunctionField
from regnf_core.schema.kinds import SKIP_LAYER, NeusFactoDescription

# The hash encoding of points within its cube, without a graph: each feature is a plane, one long row of all points.
#
# The same features as :class:`regnf_core.fields.hash_encoding.HashEncoding` gives, to the last digit. Indices are 32
# bits wide and no axis is short, so that every step runs in the processor's vector units.

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


# A network of softplus layers without a graph: each feature is a plane, one long row of all points.
#
# With a layer's result called a, what the next layer is fed is 100 softplus(a) = max(z, 0) + log(1 + exp(-|z|)),
# where z = 100 a. Both factors are part of the weights, as is the bias: every input has a last row of ones. With p =
# sigmoid(z), the slope, the logarithm is -log max(p, 1 - p): one exponential gives the value and the slope.

_BETA = 100.0
_FLAT = 20.0
"""Beyond this |z| softplus is its asymptote to float32; cutting there also keeps denormal numbers out of exp."""


class PlaneNetwork:
    """weights[i]: (out_i, in_i), biases[i]: (out_i,); of the last layer one row. Made in microseconds."""

    def __init__(self, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
        self._layers = []
        for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            fed = weight.detach() / _BETA if number else weight.detach()
            both = torch.cat((fed, bias.detach()[:, None]), dim=1)
            self._layers.append(both if number == len(weights) - 1 else both * _BETA)
        self._back = [layer[:, :-1].T.contiguous() for layer in self._layers]

    def value(self, inputs: Tensor) -> Tensor:
        """Signed distance (N,) of inputs (in + 1, N), whose last row holds ones."""
        h = inputs
        for layer in self._layers[:-1]:
            h, _ = _activated(layer, h)
        return (self._layers[-1] @ h)[0]

    def with_gradient(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and its gradient (in, N) by the inputs without the row of ones."""
        h, slopes = inputs, []
        for layer in self._layers[:-1]:
            h, slope = _activated(layer, h)
            slopes.append(slope)
        distance = (self._layers[-1] @ h)[0]
        gradient = self._back[-1]
        for layer in reversed(self._back[:-1]):
            gradient = layer @ slopes.pop().mul_(gradient)
        return distance, gradient.expand(-1, inputs.shape[1])


def _activated(layer: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """What the next layer is fed (out + 1, N), with a row of ones, and the slopes (out, N) of the activation."""
    fed = torch.empty(len(layer) + 1, inputs.shape[1])
    z = torch.mm(layer, inputs, out=fed[:-1])
    fed[-1] = 1.0
    slope = z.clamp(-_FLAT, _FLAT).sigmoid_()
    larger = 1.0 - slope
    torch.maximum(larger, slope, out=larger).log_()
    z.clamp_min_(0.0).sub_(larger)
    return fed, slope


# Evaluation of a neus-facto function at many points on the CPU: hash grid, encoding and network in planes, no graph.
#
# The class NeusFactoFunction has the same function in plain tensor algebra; tests compare the two, and points beyond
# the grid's cube are left to it.


class NeusFactoPlanes:
    """A snapshot of the function's parameters, laid out for evaluation: fitting changes them, so it is made anew."""

    def __init__(self, plain: NeusFactoFunction, grid: HashPlanes | None) -> None:
        """grid: of the function's encoding, if it has one."""
        self._plain, self._grid = plain, grid
        weights = [weight.detach() for weight in plain.mlp.weights]
        if plain.hash_encoding is not None:
            self._shape = (plain.hash_encoding.config.features_per_level, plain.hash_encoding.active_levels)
            weights[0] = _feature_first(weights[0], *self._shape)
        self._network = PlaneNetwork(weights, plain.mlp.biases)

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        z, unit, within = self._places(points)
        if within is not None:
            distance = self._plain.value(points)
            distance[within] = self.value(points[within])
            return distance
        parts = self._smooth_parts(z)
        if self._grid is not None:
            parts.append(self._grid.features(unit).flatten(0, 1))
        return self._network.value(_with_ones(parts))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3) with respect to them, in closed form."""
        z, unit, within = self._places(points)
        if within is not None:
            distance, gradient = self._plain.value_and_gradient(points)
            distance[within], gradient[within] = self.value_and_gradient(points[within])
            return distance, gradient
        parts = self._smooth_parts(z)
        encoded = None if self._grid is None else self._grid.with_derivatives(unit)
        if encoded is not None:
            parts.append(encoded.features.flatten(0, 1))
        distance, by_input = self._network.with_gradient(_with_ones(parts))
        gradient = by_input[:3]
        if self._plain.positional_encoding is not None:
            by_sines = by_input[3 : 3 + len(parts[1])]
            gradient = gradient + self._plain.positional_encoding.pull_back_planes(parts[1], by_sines)
        if self._plain.contraction == "linf":
            gradient = self._pulled_back(points, gradient)
        if encoded is not None:
            by_grid = encoded.pull_back(by_input[-len(parts[-1]) :].reshape(*self._shape, len(points)))
            by_grid /= 2.0 * self._plain.grid_radius
            gradient = gradient + (by_grid if self._plain.contraction == "none" else self._pulled_back(points, by_grid))
        return distance, gradient.T

    @staticmethod
    def _pulled_back(points: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (3, N) by the points (N, 3), from that by the contracted points."""
        return pull_back_linf(points, gradient.T).T

    def _places(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The points as the network sees them and in the grid's unit cube, (3, N) each; and the numbers of those within
        the cube, None where all are."""
        z, grid_points = self._plain.coordinates(points)
        z, unit = z.T.contiguous(), self._plain.to_unit(grid_points.T.contiguous())
        if self._grid is None or not unit.numel():
            return z, unit, None
        low, high = unit.aminmax()
        if low >= 0.0 and high <= 1.0:
            return z, unit, None
        return z, unit, ((unit >= 0.0) & (unit <= 1.0)).all(0).nonzero().squeeze(-1)

    def _smooth_parts(self, z: Tensor) -> list[Tensor]:
        encoding = self._plain.positional_encoding
        return [z] if encoding is None else [z, encoding.encode_planes(z)]


def prepared(function: NeusFactoFunction) -> NeusFactoFunction | NeusFactoPlanes:
    """What evaluates the function's present parameters fastest, without a graph: made anew for each call, because
    fitting changes them."""
    mlp, encoding = function.mlp, function.hash_encoding
    simple = mlp.activation == "softplus" and mlp.skip_at is None and len(mlp.weights) > 1
    if not simple or function.device.type != "cpu":
        return function
    grid = None if encoding is None else planes_of(encoding)
    return function if encoding is not None and grid is None else NeusFactoPlanes(function, grid)


def _with_ones(parts: list[Tensor]) -> Tensor:
    return torch.cat((*parts, torch.ones(1, parts[0].shape[1])))


def _feature_first(weight: Tensor, features: int, levels: int) -> Tensor:
    """The columns of the grid's features, which come level by level, in the order of :class:`HashPlanes`."""
    grid = features * levels
    turned = weight[:, -grid:].reshape(-1, levels, features).transpose(1, 2).flatten(1)
    return torch.cat((weight[:, :-grid], turned), dim=1)


class NeusFactoField(FunctionField[NeusFactoFunction]):
    """A :class:`NeusFactoFunction` as an SdfField."""

    def _evaluator(self) -> Evaluator:
        return native_evaluator(self.function) or prepared(self.function)


def build_neus_facto(
    description: NeusFactoDescription, tensors: Mapping[str, Tensor], head: ColorHead | None = None
) -> NeusFactoField:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device. Columns that only ever saw zeros (an unused encoding, masked levels) are left out.
    The tensors must have passed :meth:`NeusFactoDescription.check_tensors`.
    """
    layers = sum(name.endswith(".weight") for name in tensors)
    weights = [tensors[f"layers.{i}.weight"].float() for i in range(layers)]
    biases = [tensors[f"layers.{i}.bias"].float() for i in range(layers)]
    positional = PositionalEncoding.of(description.positional_encoding)
    grid = None
    if description.hash is not None and description.use_grid:
        grid = HashEncoding(description.hash, tensors["hash_table"].float(), description.level_mask)
    live = torch.tensor(_live_columns(description, positional, grid), device=weights[0].device)
    if len(live) < description.input_width:
        weights[0] = weights[0][:, live]
        if layers > SKIP_LAYER:
            hidden = weights[SKIP_LAYER - 1].shape[0]
            kept = torch.cat((torch.arange(hidden, device=live.device), live + hidden))
            weights[SKIP_LAYER] = weights[SKIP_LAYER][:, kept]
            if head is not None and layers == SKIP_LAYER + 1:  # the color sees what this layer sees
                own = head.form.own_width
                first = head.weights[0]
                head = head.with_first(torch.cat((first[:, :own], first[:, own:][:, kept]), dim=1))
    mlp = GeometryMlp(weights, biases, SKIP_LAYER)
    function = NeusFactoFunction(mlp, positional, grid, description.contraction, description.grid_radius, head)
    return NeusFactoField(function, torch.tensor(description.function_bounds, dtype=torch.float64))


def _live_columns(
    description: NeusFactoDescription, positional: PositionalEncoding | None, grid: HashEncoding | None
) -> list[int]:
    """The columns of the network's input that are ever fed something other than zero."""
    columns = [0, 1, 2]
    start = 3
    if positional is not None:
        columns += range(start, start + positional.width)
    if description.positional_encoding is not None:
        start += description.positional_encoding.width
    if grid is not None:
        columns += range(start, start + grid.width)
    return columns
