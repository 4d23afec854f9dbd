"""Volumes of features from coarse to fine, summed and decoded: NGLOD's fields (Takikawa et al. 2021)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.fields.box_extension import BoxExtension
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.geometry_mlp import GeometryMlp
from regnf_core.fields.trilinear import corner_offsets, interpolate, interpolate_with_derivative
from regnf_core.schema.kinds.feature_volumes import FeatureVolumesDescription, count_volumes


@dataclass(frozen=True)
class FeatureVolumesFunction:
    """[x, sum of the volumes' features at x] -> ReLU network. Points are taken to be within [-1, 1]^3.

    volumes[i]: (N, N, N, C), float32 or float16, first axis x; the first and last nodes lie on the cube's faces.
    """

    volumes: tuple[Tensor, ...]
    mlp: GeometryMlp

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.volumes[0].device

    def to(self, device: torch.device | str) -> FeatureVolumesFunction:
        """The same function with its parameters on another device."""
        return replace(self, volumes=tuple(v.to(device) for v in self.volumes), mlp=self.mlp.to(device))

    def value(self, points: Tensor) -> Tensor:
        """Signed distance (N,) at points (N, 3)."""
        features = torch.stack([interpolate(*_corners(volume, points)) for volume in self.volumes]).sum(0)
        return self.mlp(torch.cat((points, features), dim=-1))

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3) and its gradient (N, 3), in closed form."""
        width = self.volumes[0].shape[-1]
        features, jacobian = points.new_zeros(len(points), width), points.new_zeros(3, len(points), width)
        for volume in self.volumes:
            level, derivative = interpolate_with_derivative(*_corners(volume, points))
            features += level
            jacobian += derivative * ((volume.shape[0] - 1) / 2.0)
        distance, by_input = self.mlp.with_gradient(torch.cat((points, features), dim=-1))
        return distance, by_input[:, :3] + (jacobian * by_input[:, 3:]).sum(dim=-1).T


def build_feature_volumes(
    description: FeatureVolumesDescription, tensors: Mapping[str, Tensor]
) -> FunctionField[BoxExtension[FeatureVolumesFunction]]:
    """The field of ``description`` with its parameters in ``tensors``, extended beyond the cube [-1, 1]^3.

    Tensors keep their device; they must have passed :meth:`FeatureVolumesDescription.check_tensors`.
    """
    volumes = tuple(tensors[f"volumes.{i}"].contiguous() for i in range(count_volumes(tensors)))
    function = FeatureVolumesFunction(volumes, GeometryMlp.from_tensors(tensors))
    high = torch.ones(3, device=function.device)
    bounds = torch.tensor(description.function_bounds, dtype=torch.float64)
    return FunctionField(BoxExtension(function, -high, high, float(description.sign)), bounds)


def _corners(volume: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """The features (2, 2, 2, N, C) at the corners of the points' cells, and the weights (3, N, 1) of the upper ones."""
    nodes = volume.shape[0]
    position = (points + 1.0) * ((nodes - 1) / 2.0)
    cell = position.floor().long().clamp(0, nodes - 2)
    strides = torch.tensor([nodes * nodes, nodes, 1], device=volume.device)
    rows = (cell * strides).sum(-1) + (corner_offsets(volume.device) * strides).sum(-1, keepdim=True)  # (8, N)
    features = volume.view(nodes**3, -1).index_select(0, rows.view(-1)).float()
    return features.view(2, 2, 2, len(points), -1), (position - cell).T.unsqueeze(-1)
