"""The kinds of field that the safe format holds: one module a kind, listed in ``KINDS``. Torch-free.

docs/families.md describes how to add one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, MaxLen

from regnf_core.schema.closed import Closed
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig, PositionalEncodingDescription
from regnf_core.schema.onnx_operators import OPERATORS, SHAPE_ONLY
from regnf_core.schema.tensor_check import (
    MAX_LAYERS,
    TensorSpec,
    check_layers,
    count_layers,
    count_rows,
    layer_tensor_names,
    require,
    require_layer_count,
    require_names,
    require_shape,
)

# The kind ``mlp``: the position, with or without its sines and cosines, into a network of plain layers.

LEAKY_SLOPE = 0.01
"""Of leaky_relu for negative numbers, where nothing else is said."""

ActivationName = Literal["relu", "softplus", "sine", "tanh", "elu", "gelu", "silu", "leaky_relu"]
LayerNumbers = Annotated[tuple[Annotated[int, Ge(0), Le(MAX_LAYERS)], ...], MaxLen(MAX_LAYERS)]


@dataclass(frozen=True, kw_only=True)
class MlpDescription(FieldDescription):
    """A field of the mlp kind; see :class:`regnf_core.fields.mlp.MlpFunction`."""

    kind: Literal["mlp"]
    activation: ActivationName
    """Between layers; softplus is log(1 + exp(100 a)) / 100, gelu the exact one."""
    negative_slope: Annotated[float, Ge(0), Le(1)] = LEAKY_SLOPE
    """Of leaky_relu for negative numbers."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network sees the position alone."""
    input_at: LayerNumbers = ()
    """Layers, not the first, that see [hidden, input]."""
    normalized: LayerNumbers = ()
    """Layers whose result goes through a layer normalization before the activation."""
    output_tanh: Annotated[int, Ge(0), Le(2)] = 0
    """How often tanh is applied to the last layer's result."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines."""
        return 3 + (self.positional_encoding.width if self.positional_encoding is not None else 0)

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int:
        return tensors[f"layers.{count_layers(tensors) - 1}.weight"].shape[1]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        layers = count_layers(tensors)
        require_layer_count(layers)
        require(all(0 < i < layers for i in self.input_at), "input_at has the first layer or a missing one")
        require(all(i < layers - 1 for i in self.normalized), "normalized has the last layer or a missing one")
        norms = {f"norms.{i}.{part}" for i in self.normalized for part in ("weight", "bias")}
        require_names(tensors, layer_tensor_names(layers) | norms)
        check_layers(tensors, self.input_width, dict.fromkeys(self.input_at, self.input_width))
        for i in self.normalized:
            rows = count_rows(tensors, f"layers.{i}.weight")
            require_shape(tensors, f"norms.{i}.weight", (rows,))
            require_shape(tensors, f"norms.{i}.bias", (rows,))


# The kind ``neus_facto``: hash grid, sines and cosines and the position itself into a small softplus network.

Contraction = Literal["none", "linf", "linf_grid"]

SKIP_LAYER = 4
"""A network with more layers than this sees its input again at this one."""


@dataclass(frozen=True, kw_only=True)
class NeusFactoDescription(FieldDescription):
    """A field of the neus-facto kind; see :class:`regnf_core.fields.neus_facto.NeusFactoFunction`."""

    kind: Literal["neus_facto"]
    hash: HashGridConfig | None = None
    """None: the network has no columns for a grid."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network has no columns for sines and cosines."""
    use_grid: bool = True
    """False: the network has the grid's columns, but they were always fed zeros; no table is stored."""
    contraction: Contraction = "none"
    grid_radius: Annotated[float, Gt(0), Le(1e6)] = 2.0
    """The grid covers [-grid_radius, grid_radius]^3."""
    level_mask: Annotated[int, Ge(1), Le(32)] | None = None
    """Levels in use, coarsest first; the features of finer ones are zero. None: all."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines, grid features."""
        encodings = (self.positional_encoding, self.hash)
        return 3 + sum(encoding.width for encoding in encodings if encoding is not None)

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int:
        return tensors[f"layers.{count_layers(tensors) - 1}.weight"].shape[1]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        layers = count_layers(tensors)
        require_layer_count(layers)
        stored_grid = self.hash if self.use_grid else None
        require_names(tensors, layer_tensor_names(layers) | ({"hash_table"} if stored_grid is not None else set()))
        if stored_grid is not None:
            require_shape(tensors, "hash_table", (stored_grid.entries, stored_grid.features_per_level))
        check_layers(tensors, self.input_width, {SKIP_LAYER: self.input_width})


# The kind ``onnx``: any network, as a graph of ONNX's operators. The graph is data: names from a list, no code.

MAX_NODES = 2_000
MAX_NUMBERS = 20_000
"""Numbers that all constants together may hold; larger arrays are tensors."""
MAX_BATCH = 1 << 16

_Name = Annotated[str, MaxLen(32)]
_Names = Annotated[tuple[_Name, ...], MaxLen(64)]
_Number = int | float
AttributeValue = int | float | Annotated[str, MaxLen(64)] | Annotated[tuple[_Number, ...], MaxLen(64)]


@dataclass(frozen=True)
class NodeDescription(Closed):
    """One operation: its operator, the names of what goes in ("" if left out) and comes out, its settings."""

    op: Annotated[str, MaxLen(40)]
    inputs: _Names
    outputs: _Names
    attributes: Annotated[dict[Annotated[str, MaxLen(40)], AttributeValue], MaxLen(64)]


@dataclass(frozen=True)
class ConstantDescription(Closed):
    """A small array: row after row, last axis fastest."""

    type: Literal["float32", "int64", "bool"]
    shape: Annotated[tuple[Annotated[int, Ge(0), Le(MAX_NUMBERS)], ...], MaxLen(8)]
    values: Annotated[tuple[_Number, ...], MaxLen(MAX_NUMBERS)]


@dataclass(frozen=True, kw_only=True)
class OnnxDescription(FieldDescription):
    """A field of the onnx kind; see :class:`regnf_core.fields.onnx.graph.OnnxFunction`."""

    kind: Literal["onnx"]
    nodes: Annotated[tuple[NodeDescription, ...], Len(1, MAX_NODES)]
    """In the order of evaluation."""
    constants: Annotated[dict[_Name, ConstantDescription], MaxLen(MAX_NODES)]
    input: _Name
    output: _Name
    batch: Annotated[int, Ge(1), Le(MAX_BATCH)]
    """How many points the graph is always given at once; fewer are filled up."""
    opset: Annotated[int, Ge(13), Le(26)]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        require_names(tensors, set(tensors), integers={name for name, spec in tensors.items() if spec.dtype == "I32"})
        numbers = sum(len(constant.values) for constant in self.constants.values())
        require(numbers <= MAX_NUMBERS, f"the constants hold {numbers} numbers; at most {MAX_NUMBERS} are allowed")
        given = [self.input, *tensors, *self.constants]
        require(len(set(given)) == len(given), "two values have the same name")
        self._check_graph(dict.fromkeys(given, False) | {self.input: True})

    def _check_graph(self, by_points: dict[str, bool]) -> None:
        """``by_points``: the names known so far, and whether their values depend on the points."""
        for number, node in enumerate(self.nodes):
            where = f"node {number} ({node.op[:40]})"
            signature = OPERATORS.get(node.op)
            if signature is None:
                require(False, f"{where}: the operator is not supported")
                continue
            require(signature.least <= len(node.inputs) <= signature.most, f"{where}: {len(node.inputs)} inputs")
            require(1 <= len(node.outputs) <= signature.outputs, f"{where}: {len(node.outputs)} outputs")
            known = all(name == "" or name in by_points for name in node.inputs)
            require(known, f"{where}: it has an input that no node computes")
            require(
                all(name and name not in by_points for name in node.outputs), f"{where}: its output is computed twice"
            )
            moving = [by_points.get(name, False) for name in node.inputs]
            settled = not any(moving[i] for i in signature.settled if i < len(moving))
            require(settled, f"{where}: its shape would depend on the points")
            by_points |= dict.fromkeys(node.outputs, any(moving) and node.op not in SHAPE_ONLY)
        require(by_points.get(self.output, False), "the output does not depend on the points")


def last_uses(nodes: Sequence[NodeDescription], output: str) -> list[tuple[str, ...]]:
    """For each node the names that nothing after it reads; ``output`` is read in the end."""
    read = {"", output}
    found = []
    for node in reversed(nodes):
        found.append(tuple(dict.fromkeys(name for name in (*node.inputs, *node.outputs) if name not in read)))
        read.update(found[-1])
    return found[::-1]


# The kind ``mesh``: the exact distance to triangles.


@dataclass(frozen=True, kw_only=True)
class MeshDescription(FieldDescription):
    """A triangle mesh; see :class:`regnf_core.fields.mesh.MeshField`."""

    kind: Literal["mesh"]
    inside_above: Annotated[float, Ge(-1), Le(1)] = 0.5
    """Matter is where the generalized winding number exceeds this."""

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...]:
        """(V,)"""
        return tensors["vertices"].shape[:1]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        require_names(tensors, {"vertices", "faces"}, integers={"faces"})
        for name in ("vertices", "faces"):
            require_shape(tensors, name, (count_rows(tensors, name), 3))


# The kind ``voxel_grid``: distances at the nodes of a regular grid.

Coordinate = Annotated[float, Ge(-1e9), Le(1e9)]
Place = tuple[Coordinate, Coordinate, Coordinate]
Length = Annotated[float, Ge(1e-9), Le(1e9)]
WEIGHTS = "weights"
"""The tensor that says how much was seen of each node: 0 where nothing was. It may be missing."""


@dataclass(frozen=True, kw_only=True)
class VoxelGridDescription(FieldDescription):
    """A field of the voxel_grid kind; see :class:`regnf_core.fields.build.VoxelGridFunction`."""

    kind: Literal["voxel_grid"]
    origin: Place
    """Where node (0, 0, 0) is, in the function's coordinates."""
    spacing: tuple[Length, Length, Length]
    """From node to node along x, y and z."""

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...]:
        """(X, Y, Z)"""
        return tensors["values"].shape

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        require_names(tensors, {"values"} | (tensors.keys() & {WEIGHTS}))
        shape = tensors["values"].shape
        require(len(shape) == 3 and min(shape) >= 2, f"values has shape {shape}, expected at least two nodes per axis")
        if WEIGHTS in tensors:
            require_shape(tensors, WEIGHTS, shape)


# The kind ``neural_points``: a map of points with features, decoded by a small network.


@dataclass(frozen=True, kw_only=True)
class NeuralPointsDescription(FieldDescription):
    """A field of the neural_points kind; see :class:`regnf_core.fields.neural_points.NeuralPointsFunction`."""

    kind: Literal["neural_points"]
    cell_size: Length
    """Edge of the cells that hold one point each."""
    buffer_size: Annotated[int, Ge(1), Le(1 << 40)]
    """Cells have numbers below this."""
    reach: Annotated[float, Ge(1), Le(8)]
    """Points are looked for in cells less than this many cells away."""
    max_distance: Length
    """Points farther away than this do not count."""
    neighbors: Annotated[int, Ge(1), Le(64)]
    """How many of the nearest points count."""
    blend_first: bool
    """True: features are blended, then decoded; false: the other way round."""
    oriented: bool = False
    """Whether the points' frames are turned: quaternions tell how."""

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        layers = count_layers(tensors)
        names = layer_tensor_names(layers)
        require_names(tensors, names | {"points", "features"} | ({"orientations"} if self.oriented else set()))
        points = count_rows(tensors, "points")
        require_shape(tensors, "points", (points, 3))
        shape = tensors["features"].shape
        require(len(shape) == 2, f"features has shape {shape}, expected one row per point")
        require_shape(tensors, "features", (points, shape[1]))
        if self.oriented:
            require_shape(tensors, "orientations", (points, 4))
        check_layers(tensors, shape[1] + 3)


# The kind ``voxel_blocks``: distances in blocks of voxels, as maps made from depth images have them.


@dataclass(frozen=True, kw_only=True)
class VoxelBlocksDescription(FieldDescription):
    """A field of the voxel_blocks kind; see :class:`regnf_core.fields.voxel_blocks.VoxelBlocksFunction`."""

    kind: Literal["voxel_blocks"]
    origin: Place = (0.0, 0.0, 0.0)
    """Where the first node of block (0, 0, 0) is, in the function's coordinates."""
    voxel_size: Length
    """From node to node."""

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...]:
        """(B, R, R, R)"""
        return tensors["values"].shape

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        require_names(tensors, {"values", "blocks"} | (tensors.keys() & {WEIGHTS}), integers={"blocks"})
        blocks = count_rows(tensors, "blocks")
        require_shape(tensors, "blocks", (blocks, 3))
        shape = tensors["values"].shape
        require(len(shape) == 4 and shape[1] >= 1, f"values has shape {shape}, expected blocks of voxels")
        require_shape(tensors, "values", (blocks, shape[1], shape[1], shape[1]))
        if WEIGHTS in tensors:
            require_shape(tensors, WEIGHTS, shape)


KINDS: dict[str, type[FieldDescription]] = {
    "neus_facto": NeusFactoDescription,
    "mlp": MlpDescription,
    "mesh": MeshDescription,
    "onnx": OnnxDescription,
    "neural_points": NeuralPointsDescription,
    "voxel_grid": VoxelGridDescription,
    "voxel_blocks": VoxelBlocksDescription,
}
"""By the description's ``kind``."""
