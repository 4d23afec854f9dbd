"""What a registration needs to know of a library object beforehand: made once for a field, independent of any scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import MODEL
from regnf_core.robust.devices import working_device
from regnf_core.robust.model.extremal_points import extremal_points
from regnf_core.robust.model.hull import Hull
from regnf_core.robust.model.self_symmetry import SelfSymmetry, confirm_symmetries, propose_symmetries
from regnf_core.robust.model.signature import signature
from regnf_core.robust.samples import Samples, fixed_generator
from regnf_core.robust.sampling import sample_object_surface
from regnf_core.robust.search.distance_grid import DistanceGrid, distance_grid
from regnf_core.robust.search.rotations import super_fibonacci
from regnf_core.robust.working_frame import WorkingField, WorkingFrame


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object's surface and symmetries. Points in the working frame: the surface's centroid at 0, its diameter 1.

    spacing: between samples · extremal_points: (E, 3) outermost points, by which two placements are compared ·
    signature: (310,), see :mod:`regnf_core.robust.model.signature`.
    """

    frame: WorkingFrame
    samples: Samples
    spacing: float
    extremal_points: Tensor
    symmetry: SelfSymmetry
    signature: Tensor

    @cached_property
    def distance_grid(self) -> DistanceGrid:
        """Distances to the samples, on a grid."""
        return distance_grid(self.samples, self.spacing)

    @cached_property
    def hull(self) -> Hull:
        """The samples' convex hull."""
        return Hull.of(self.samples.on_surface())

    def to(self, device: torch.device | str) -> ObjectModel:
        """The same model on another device; itself where it is there already. The frame stays on the CPU."""
        if self.samples.points.device == torch.device(device):
            return self
        moved = ObjectModel(
            self.frame,
            self.samples.to(device),
            self.spacing,
            self.extremal_points.to(device),
            self.symmetry.to(device),
            self.signature.to(device),
        )
        for name in ("distance_grid", "hull"):
            if name in self.__dict__:
                moved.__dict__[name] = self.__dict__[name].to(device)
        return moved

    def field(self, obj: SdfField) -> WorkingField:
        """The object's field, the one that this model was made from, in the working frame."""
        return WorkingField(obj, self.frame)


def model_object(obj: SdfField, options: RobustOptions | None = None) -> ObjectModel:
    """Sample the object's surface and find its symmetries, once for all registrations.

    Deterministic. Of the options ``object_samples`` alone matters. The samples are worked on where the field is; the
    model is on the CPU.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT), InvalidInputError (FIELD_NOT_FINITE).
    """
    options = options or RobustOptions()
    generator = fixed_generator()
    sampled = sample_object_surface(obj, options.object_samples, generator)
    samples = sampled.samples
    outermost = extremal_points(samples.on_surface(), MODEL.extremal_points)
    device = working_device(obj)
    there, rotations = samples.to(device), super_fibonacci(MODEL.rotations).to(device)
    grid = distance_grid(there, sampled.spacing)
    proposed = propose_symmetries(grid, there, outermost, rotations, generator)
    symmetry = confirm_symmetries(proposed, sampled.field, there, outermost, generator).to("cpu")
    sampled.field.require_finite()
    model = ObjectModel(sampled.frame, samples, sampled.spacing, outermost, symmetry, signature(samples))
    model.__dict__["distance_grid"] = grid.to("cpu")  # what the property would make again
    return model
