"""The kinds of field that the safe format holds: one module a kind, listed in ``KINDS``. Torch-free.

docs/families.md describes how to add one.
"""

from __future__ import annotations

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

KINDS: dict[str, type[FieldDescription]] = {
    "neus_facto": NeusFactoDescription,
    "mlp": MlpDescription,
    "mesh": MeshDescription,
    "onnx": OnnxDescription,
    "neural_points": NeuralPointsDescription,
    "grid_mlp": GridMlpDescription,
    "grid_network": GridNetworkDescription,
    "feature_volumes": FeatureVolumesDescription,
    "voxel_grid": VoxelGridDescription,
    "voxel_blocks": VoxelBlocksDescription,
}
"""By the description's ``kind``."""
