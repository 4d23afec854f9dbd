"""From a stored description and its tensors to a field that can be evaluated."""

from __future__ import annotations

import os
from collections.abc import Mapping

import torch
from safetensors import safe_open
from torch import Tensor

from regnf_core.errors import InvalidOptionsError
from regnf_core.fields.base import SdfField
from regnf_core.fields.color_head import build_color_head
from regnf_core.fields.feature_volumes import build_feature_volumes
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.grid_mlp import build_grid_mlp
from regnf_core.fields.grid_network import build_grid_network
from regnf_core.fields.mlp import build_mlp
from regnf_core.fields.neural_points import build_neural_points
from regnf_core.fields.neus_facto import build_neus_facto
from regnf_core.fields.observation import ObservedField, stored_observation
from regnf_core.fields.onnx.graph import build_onnx
from regnf_core.fields.scaled import ScaledField
from regnf_core.fields.transformed import TransformedField
from regnf_core.fields.voxel_blocks import build_voxel_blocks
from regnf_core.fields.voxel_grid import build_voxel_grid
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.color import VALUES, NetworkColor, split_color
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds.feature_volumes import FeatureVolumesDescription
from regnf_core.schema.kinds.grid_mlp import GridMlpDescription
from regnf_core.schema.kinds.grid_network import GridNetworkDescription
from regnf_core.schema.kinds.mesh import MeshDescription
from regnf_core.schema.kinds.mlp import MlpDescription
from regnf_core.schema.kinds.neural_points import NeuralPointsDescription
from regnf_core.schema.kinds.neus_facto import NeusFactoDescription
from regnf_core.schema.kinds.onnx import OnnxDescription
from regnf_core.schema.kinds.voxel_blocks import VoxelBlocksDescription
from regnf_core.schema.kinds.voxel_grid import VoxelGridDescription
from regnf_core.schema.observation_grid import OBSERVATION
from regnf_core.schema.safe_format import read_header


def open_field(path: str | os.PathLike[str], device: torch.device | str = "cpu") -> SdfField:
    """Open the field file ``path``, with its parameters on ``device``. On a CPU, float32 tensors are memory-mapped.

    Raises FieldFormatError: SAFE_FORMAT_INVALID, SAFE_FORMAT_VERSION, FIELD_KIND_UNKNOWN, FIELD_SHAPES_MISMATCH, and
    what :func:`build_field` raises; InvalidOptionsError for a device that is not there.
    """
    description, names = read_header(path)
    with safe_open(os.fspath(path), framework="pt", device=str(usable_device(device))) as file:
        return build_field(description, {name: file.get_tensor(name) for name in names})


def usable_device(device: torch.device | str) -> torch.device:
    """The device, if torch can use it on this machine. Raises InvalidOptionsError."""
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (AssertionError, NotImplementedError, RuntimeError, TypeError) as error:
        hint = 'Take "cpu"; `regnf doctor` says whether torch finds a GPU.'
        raise InvalidOptionsError(f"torch cannot use the device {device!r:.40} here", hint=hint) from error
    return found


def build_field(description: FieldDescription, tensors: Mapping[str, Tensor]) -> SdfField:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device. They must have passed the description's ``check``.
    Raises FieldFormatError: FIELD_INDEX_INVALID, MESH_INVALID or ONNX_GRAPH_INVALID, by kind.
    """
    parameters = {name: tensor for name, tensor in tensors.items() if name != OBSERVATION}
    colors: dict[str, Tensor] = {}
    if description.color is not None:
        parameters, colors = split_color(parameters)
    field = _build_kind(description, parameters, colors)
    if isinstance(field, FunctionField):
        field = field.with_inverse_deviation(description.inverse_deviation)
    if description.observation is not None:
        field = ObservedField(field, stored_observation(description.observation, tensors[OBSERVATION]))
    if description.world_scale != 1.0 or description.sign != 1:
        field = ScaledField(field, description.world_scale, description.sign)
    if description.placement is None:
        return field
    return TransformedField(field, Sim3.from_matrix(description.placement.transform).inverse())


def _build_kind(description: FieldDescription, tensors: Mapping[str, Tensor], colors: Mapping[str, Tensor]) -> SdfField:
    """The kind's own function as a field, without the entries that all kinds share: one case a kind.

    colors: the tensors of its color, names without their beginning.
    """
    color = description.color
    head = build_color_head(color, colors) if isinstance(color, NetworkColor) else None
    match description:
        case NeusFactoDescription():
            return build_neus_facto(description, tensors, head)
        case MlpDescription():
            return build_mlp(description, tensors, head)
        case MeshDescription():
            from regnf_core.fields.mesh import build_mesh  # loads libigl and trimesh: nearly two seconds

            return build_mesh(description, tensors, colors.get(VALUES))
        case OnnxDescription():
            return build_onnx(description, tensors)
        case NeuralPointsDescription():
            return build_neural_points(description, tensors)
        case GridMlpDescription():
            return build_grid_mlp(description, tensors)
        case GridNetworkDescription():
            return build_grid_network(description, tensors)
        case FeatureVolumesDescription():
            return build_feature_volumes(description, tensors)
        case VoxelGridDescription():
            return build_voxel_grid(description, tensors, colors.get(VALUES))
        case VoxelBlocksDescription():
            return build_voxel_blocks(description, tensors, colors.get(VALUES))
        case _:
            raise TypeError(f"no evaluator for fields of the class {type(description).__name__}")
