"""A fitted field in the layout of sdfstudio's neus-facto checkpoints, colors included."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from regnf_core.files import atomic_path
from regnf_fit.images.network import RadianceField
from regnf_fit.local_frame import LocalFrame
from regnf_fit.network import POSITION_DEGREE

_EMBEDDING = 32
"""Columns of the color's network for an image's appearance, which our fields do not have: zeros."""


def write_sdfstudio(field: RadianceField, bounds: Tensor, sharpness: float, path: Path, frame: LocalFrame) -> None:
    """Write a checkpoint {step, pipeline} to ``path`` atomically. bounds: (2, 3), the field's frame · frame: that one;
    where it is not the images' own, dataparser_transforms.json beside the checkpoint says how it lies in theirs.

    The distances are those of the field before its table is rounded to half precision. What the tensors do not say
    stands in ``config.yml`` beside it, as sdfstudio names it; a file of that name that is there already stays.
    """
    layers = dict(enumerate(zip(field.weights, field.biases, strict=True)))
    last = len(layers) - 1
    entries: dict[str, Tensor] = {"aabb": bounds.float(), "encoding.params": field.table.flatten()}
    for i, (weight, bias) in layers.items():
        if i == last:  # the feature's rows follow the distance's
            weight, bias = torch.cat((weight, field.feature_weight)), torch.cat((bias, field.feature_bias))
        entries |= _normalized(f"glin{i}", weight, bias)
    colors = zip(field.color_weights, field.color_biases, strict=True)
    for i, (weight, bias) in enumerate(colors):
        if i == 0:
            weight = torch.cat((weight, weight.new_zeros(len(weight), _EMBEDDING)), dim=1)
        entries |= _normalized(f"clin{i}", weight, bias)
    # sdfstudio keeps a tenth of the sharpness's logarithm; the density of VolSDF beside it is not used
    entries["deviation_network.variance"] = torch.tensor([math.log(sharpness) / 10.0])
    entries["laplace_density.beta"] = torch.tensor([0.1])
    entries["laplace_density.beta_min"] = torch.tensor([1e-4])
    entries["embedding_appearance.embedding.weight"] = torch.zeros(1, _EMBEDDING)
    pipeline = {f"_model.field.{name}": value.detach().cpu().clone() for name, value in entries.items()}
    with atomic_path(path) as temporary:
        torch.save({"step": field.options.iterations, "pipeline": pipeline}, temporary)
    if not frame.same:
        turn = [[*row, -float(shift)] for row, shift in zip(np.eye(3).tolist(), frame.origin, strict=True)]
        with atomic_path(path.with_name("dataparser_transforms.json")) as temporary:
            temporary.write_text(json.dumps({"transform": turn, "scale": frame.scale}), encoding="utf-8")
    settings = path.with_name("config.yml")
    if not settings.exists():
        with atomic_path(settings) as temporary:
            temporary.write_text(yaml.safe_dump(_settings(field), sort_keys=False), encoding="utf-8")


def _settings(field: RadianceField) -> dict[str, Any]:
    grid = field.options.grid
    sdf_field = {
        "num_layers": field.options.hidden_layers,
        "hidden_dim": field.options.hidden_width,
        "use_grid_feature": True,
        "encoding_type": "hash",
        "num_levels": grid.levels,
        "max_res": round(grid.scales()[-1]) + 1,
        "base_res": grid.base_resolution,
        "log2_hashmap_size": grid.log2_table_size,
        "hash_features_per_level": grid.features_per_level,
        "hash_smoothstep": grid.interpolation == "smoothstep",
        "position_encoding_max_degree": POSITION_DEGREE,
        "use_position_encoding": True,
    }
    return {"method_name": "neus-facto", "pipeline": {"model": {"sdf_field": sdf_field}}}


def _normalized(name: str, weight: Tensor, bias: Tensor) -> dict[str, Tensor]:
    """A layer with weight normalization: W = g v / |v|, row by row; here v = W."""
    return {
        f"{name}.weight_g": weight.norm(dim=1, keepdim=True),
        f"{name}.weight_v": weight,
        f"{name}.bias": bias,
    }
