"""All that a registration needs to know of a library object beforehand: made once a field, independent of any scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.options import RobustOptions
from regnf_core.robust.model.extremal_points import extreme_points
from regnf_core.robust.model.self_symmetry import SelfSymmetry, confirmed, self_symmetry
from regnf_core.robust.model.signature import signature
from regnf_core.robust.residuals import Samples
from regnf_core.robust.samples import sample_object_surface
from regnf_core.robust.search.distance_grid import ProxyField, proxy_of
from regnf_core.robust.search.rotations import super_fibonacci
from regnf_core.robust.working_frame import WorkingField, WorkingFrame

_EXTREMES = 16
_SEED = 0  # an object's model is the same for every registration
_ROTATIONS = 600  # tried for symmetries


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object's surface and symmetries. Points in the working frame: the surface's centroid at 0, its diameter 1.

    spacing: between samples · extremes: (E, 3) outermost points, by which two placements are told apart · signature:
    (310,), see :mod:`regnf_core.robust.model.signature`.
    """

    frame: WorkingFrame
    samples: Samples
    spacing: float
    extremes: Tensor
    symmetry: SelfSymmetry
    signature: Tensor

    @cached_property
    def proxy(self) -> ProxyField:
        """The distance table made from the samples."""
        return proxy_of(self.samples, self.spacing)

    def field(self, obj: SdfField) -> WorkingField:
        """The object's field, the one that this model was made from, in the working frame."""
        return WorkingField(obj, self.frame)


def model_object(obj: SdfField, options: RobustOptions | None = None) -> ObjectModel:
    """Sample the object's surface and find its symmetries, once for all registrations.

    Deterministic. Of the options ``object_samples`` alone matters.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT), InvalidInputError (FIELD_NOT_FINITE).
    """
    options = options or RobustOptions()
    generator = torch.Generator().manual_seed(_SEED)
    sampled = sample_object_surface(obj, options.object_samples, generator)
    extremes = extreme_points(sampled.samples.on_surface(), _EXTREMES)
    proxy = proxy_of(sampled.samples, sampled.spacing)
    proposed = self_symmetry(proxy, sampled.samples, extremes, super_fibonacci(_ROTATIONS), generator)
    symmetry = confirmed(proposed, sampled.field, sampled.samples, extremes, generator)
    samples = sampled.samples
    model = ObjectModel(sampled.frame, samples, sampled.spacing, extremes, symmetry, signature(samples))
    model.__dict__["proxy"] = proxy  # what the property would make again
    return model
