"""From a description and its tensors to a field that can be evaluated."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from regnf_core.fields.description import SKIP_LAYER, NeusFactoDescription
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.fields.neus_facto import NeusFactoField, NeusFactoFunction
from regnf_core.fields.positional_encoding import PositionalEncoding


def build_neus_facto(description: NeusFactoDescription, tensors: Mapping[str, Tensor]) -> NeusFactoField:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device. Columns that only ever saw zeros (an unused encoding, masked levels) are left out.
    The tensors must have passed :meth:`NeusFactoDescription.check_tensors`.
    """
    layers = sum(name.endswith(".weight") for name in tensors)
    weights = [tensors[f"layers.{i}.weight"].float() for i in range(layers)]
    biases = [tensors[f"layers.{i}.bias"].float() for i in range(layers)]
    encoding = description.positional_encoding
    positional = None
    if encoding is not None and encoding.used and encoding.degree > 0:
        positional = PositionalEncoding.with_two_pi(encoding.degree, encoding.two_pi)
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
    function = NeusFactoFunction(
        GeometryMlp(weights, biases, SKIP_LAYER), positional, grid, description.contraction, description.grid_radius
    )
    return NeusFactoField(function, torch.tensor(description.bounds, dtype=torch.float64))


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
