"""The kind ``mesh``: the exact distance to triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from regnf_core.schema.kinds.kind import FieldDescription
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require_names, require_shape

if TYPE_CHECKING:
    from torch import Tensor

    from regnf_core.fields.mesh import MeshField


@dataclass(frozen=True, kw_only=True)
class MeshDescription(FieldDescription):
    """A triangle mesh; see :class:`regnf_core.fields.mesh.MeshField`. No entries of its own."""

    family: Literal["mesh"]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        require_names(tensors, {"vertices", "faces"}, integers={"faces"})
        for name in ("vertices", "faces"):
            require_shape(tensors, name, (count_rows(tensors, name), 3))

    def build(self, tensors: Mapping[str, Tensor]) -> MeshField:
        """The exact distance to the mesh. Raises FieldFormatError (MESH_INVALID) for indices of no vertex."""
        from regnf_core.fields.mesh import MeshField

        return MeshField(tensors["vertices"].cpu().numpy(), tensors["faces"].cpu().numpy(), self.function_bounds)
