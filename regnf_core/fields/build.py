"""From a stored description and its tensors to a field that can be evaluated."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

from regnf_core.errors import InvalidOptionsError
from regnf_core.fields.color_head import build_color_head
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.mlp import build_mlp
from regnf_core.fields.neural_points import build_neural_points
from regnf_core.fields.neus_facto import build_neus_facto
from regnf_core.fields.observation import (
    ColoredField,
    ColorFunction,
    FieldView,
    Observation,
    ObservedField,
    OnDevice,
    SdfField,
    inverse_deviation_of,
    observation_of,
    stored_observation,
)
from regnf_core.fields.onnx.graph import build_onnx
from regnf_core.fields.user_fields import BoxExtension, Evaluator, FunctionField
from regnf_core.fields.voxel_blocks import (
    build_voxel_blocks,
    corner_offsets,
    interpolate,
    interpolate_colors,
    interpolate_with_derivative,
)
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.native.steps import NativeModel, native_model
from regnf_core.schema.description import OBSERVATION, VALUES, FieldDescription, NetworkColor, split_color
from regnf_core.schema.kinds import (
    MeshDescription,
    MlpDescription,
    NeuralPointsDescription,
    NeusFactoDescription,
    OnnxDescription,
    VoxelBlocksDescription,
    VoxelGridDescription,
)
from regnf_core.schema.safe_format import read_header

# A field in another unit, or with the opposite sign.


class ScaledField(FieldView):
    """S(x) = sign * scale * f(x / scale): ``scale`` is the length of one unit of f's coordinates, in the new unit.

    Coordinates and distances scale together, so the gradient's norm stays what it was.
    """

    def __init__(self, field: SdfField, scale: float = 1.0, sign: int = 1) -> None:
        self.scale, self.sign = scale, sign
        super().__init__(field)

    def _color_of(self, field: ColoredField) -> ColorFunction:
        return partial(_color_in_unit, field, self.scale)

    @property
    def bounds(self) -> Tensor:
        return self.field.bounds * self.scale

    @property
    def observation(self) -> Observation | None:
        seen = observation_of(self.field)
        identity = torch.eye(3, dtype=torch.float64)
        scaling = Sim3(torch.tensor(1.0 / self.scale, dtype=torch.float64), identity, identity.new_zeros(3))
        return None if seen is None else seen.seen_in(scaling)

    @property
    def inverse_deviation(self) -> float | None:
        inverse = inverse_deviation_of(self.field)
        return None if inverse is None else inverse / self.scale

    def native_model(self) -> NativeModel | None:
        """For compiled code, where the field has such."""
        found, scale = native_model(self.field), self.scale
        return None if found is None else found.seen_by(np.eye(3) / scale, np.zeros(3), self.sign * scale)

    def to(self, device: torch.device | str) -> ScaledField:
        return ScaledField(self.field.to(device), self.scale, self.sign)

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.field.signed_distance(points / self.scale) * (self.sign * self.scale)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        distance, gradient = self.field.signed_distance_and_gradient(points / self.scale)
        return distance * (self.sign * self.scale), gradient * self.sign


def _color_in_unit(field: ColoredField, scale: float, points: Tensor, directions: Tensor) -> Tensor:
    return field.color(points / scale, directions)


# A field known at the nodes of a regular grid, interpolated between them.


@dataclass(frozen=True)
class VoxelGridFunction(OnDevice):
    """Trilinear interpolation of values (X, Y, Z), float32 or float16; node (i, j, k) is at origin + spacing (i, j, k).

    origin, spacing: (3,) float32. Points are taken to be within the grid.
    """

    values: Tensor
    origin: Tensor
    spacing: Tensor
    colors: Tensor | None = None
    """(X, Y, Z, 3); a node with a negative number has none."""

    @property
    def device(self) -> torch.device:
        return self.values.device

    @property
    def has_color(self) -> bool:
        return self.colors is not None

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) at points (N, 3), trilinear between the nodes that have one; black where none has."""
        del directions
        assert self.colors is not None
        index, weights = self._cells(points)
        return interpolate_colors(self.colors.view(-1, 3)[index], weights)

    def value(self, points: Tensor) -> Tensor:
        index, weights = self._cells(points)
        return interpolate(self._values(index), weights)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Value (N,) at points (N, 3) and its gradient (N, 3); on a cell's border, that of the cell beyond."""
        index, weights = self._cells(points)
        value, derivative = interpolate_with_derivative(self._values(index), weights)
        return value, derivative.T / self.spacing

    def _values(self, index: Tensor) -> Tensor:
        return self.values.view(-1).index_select(0, index.view(-1)).float().view(2, 2, 2, -1)

    def _cells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The corners (8, N) of the points' cells among all nodes, and the weights (3, N) of the upper ones."""
        position = (points - self.origin) / self.spacing
        last = torch.tensor(self.values.shape, device=self.device) - 2
        cell = torch.minimum(position.floor().long().clamp_min(0), last)  # (N, 3)
        _, rows, columns = self.values.shape
        strides = torch.tensor([rows * columns, columns, 1], device=self.device)
        index = (cell * strides).sum(-1) + (corner_offsets(self.device) * strides).sum(-1, keepdim=True)  # (8, N)
        return index, (position - cell).T


class VoxelGridField(FunctionField[BoxExtension[VoxelGridFunction]]):
    """A :class:`VoxelGridFunction` as an SdfField."""

    def native_model(self) -> NativeModel | None:
        """For compiled code; values in float16 have none."""
        box, grid = self.function, self.function.function
        steps = compiled.steps_for(grid.values)
        if steps is None or not grid.values.is_contiguous():
            return None
        described = compiled.voxels(grid.values.shape, box.low, box.high, grid.spacing, box.outward, grid.values)
        return NativeModel(steps.voxels, described)

    def _evaluator(self) -> Evaluator:
        return self.native_model() or self.function


def build_voxel_grid(
    description: VoxelGridDescription, tensors: Mapping[str, Tensor], colors: Tensor | None = None
) -> VoxelGridField:
    """The field of ``description`` with its values in ``tensors``, extended beyond the grid. colors: of the nodes.

    The tensors keep their device and type; they must have passed :meth:`VoxelGridDescription.check_tensors`.
    """
    values = tensors["values"].contiguous()
    origin = torch.tensor(description.origin, dtype=torch.float64)
    spacing = torch.tensor(description.spacing, dtype=torch.float64)
    high = origin + spacing * (torch.tensor(values.shape) - 1)
    origin, spacing, high = (corner.to(device=values.device, dtype=torch.float32) for corner in (origin, spacing, high))
    colors = None if colors is None else colors.contiguous()
    function = BoxExtension(VoxelGridFunction(values, origin, spacing, colors), origin, high, float(description.sign))
    return VoxelGridField(function, torch.tensor(description.function_bounds, dtype=torch.float64))


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
        hint = 'Use "cpu". `regnf doctor` checks whether torch finds a GPU.'
        raise InvalidOptionsError(f"torch cannot use the device {device!r:.40} on this machine", hint=hint) from error
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
        case VoxelGridDescription():
            return build_voxel_grid(description, tensors, colors.get(VALUES))
        case VoxelBlocksDescription():
            return build_voxel_blocks(description, tensors, colors.get(VALUES))
        case _:
            raise TypeError(f"no evaluator for fields of the class {type(description).__name__}")
