"""The kind ``mesh``: the exact distance to triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require_names, require_shape


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
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        require_names(tensors, {"vertices", "faces"}, integers={"faces"})
        for name in ("vertices", "faces"):
            require_shape(tensors, name, (count_rows(tensors, name), 3))
