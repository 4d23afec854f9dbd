"""Fields of the neus-facto kind: hash encoding, sines and cosines and the point itself into a small network.

The function is that of sdfstudio's and nerfstudio's neus-facto, of NeuS (no grid) and of kin; a description says which.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from regnf_core.fields.color_head import ColorHead, PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.native_evaluator import native_evaluator
from regnf_core.fields.neus_facto_function import GeometryMlp, NeusFactoFunction
from regnf_core.fields.user_fields import Evaluator, FunctionField
from regnf_core.native.steps import NativeModel
from regnf_core.schema.kinds import SKIP_LAYER, NeusFactoDescription


class NeusFactoField(FunctionField[NeusFactoFunction]):
    """A :class:`NeusFactoFunction` as an SdfField."""

    def _evaluator(self) -> Evaluator:
        return native_evaluator(self.function) or self.function

    def native_model(self) -> NativeModel | None:
        """For compiled code, where it knows this form of network."""
        return native_evaluator(self.function)


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
