"""What is known of a library object before any scene: samples, symmetries, signature."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from regnf_core.document import ObjectSymmetry
from regnf_core.errors import FieldFormatError, atomic_path
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.exponential_map import rotation_log
from regnf_core.geometry.metrics import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import MODEL, SIGNATURE
from regnf_core.robust.refine.levenberg_marquardt import RefinementContext, Settings, coarse_to_fine, minimize
from regnf_core.robust.refine.loss import disagreement
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.residuals import DistanceModel, SurfacePair, residuals
from regnf_core.robust.search.bounds import SAME_SCALE, super_fibonacci, turns_about
from regnf_core.robust.search.distance_grid import DistanceGrid, distance_grid
from regnf_core.robust.working_frame import (
    Samples,
    WorkingField,
    WorkingFrame,
    fixed_generator,
    sample_object_surface,
    subsample,
    working_device,
)

# An object's own symmetries, found by registering it with itself: proposed on its samples, confirmed by its field.

_SCORE_WIDTH = MODEL.stages[-1].score_width


@dataclass(frozen=True, eq=False)
class SelfSymmetry(Bundle):
    """Rigid transforms (K,) that carry the object, or most of it, onto itself; the identity is left out.

    axis: (3,) when every turn about it is a symmetry · deviation: (K,) the share of the surface that each transform
    does not carry onto the surface: near 0 for a symmetry, more for a transform that only resembles one.
    """

    T: Sim3
    axis: Tensor | None
    deviation: Tensor

    def group(self) -> ObjectSymmetry:
        """The symmetries that the object's field confirms. On the CPU."""
        exact = self.T[self.deviation <= MODEL.max_deviating_share]
        omega = rotation_log(exact.rotation)
        if self.axis is not None:
            across = int((~_about(exact, self.axis)).sum())
            return ObjectSymmetry(1 + min(across, 1), _tuple(self.axis), True)
        axes = omega / omega.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        one_axis = len(axes) > 0 and bool(((axes @ axes[0]).abs() >= MODEL.min_parallel_cosine).all())
        return ObjectSymmetry(1 + len(axes), _tuple(axes[0]) if one_axis else None, False)


def propose_symmetries(
    obj: DistanceModel, B: Samples, extremal_points: Tensor, rotations: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """Likely symmetries of the object with the samples B (working frame, centroid at 0) and the distance model ``obj``.

    rotations: (K, 3, 3) to try, on the device of B and obj; what is found is on the CPU. The field still has to confirm
    it.
    """
    few = subsample(B, MODEL.points, generator)
    itself = SurfacePair(obj, obj, few, few)
    context = RefinementContext(extremal_points, generator, SAME_SCALE)
    found = coarse_to_fine(itself, PoseCandidates.start(_rigid(rotations)), MODEL.stages, context)
    identity = _rigid(torch.eye(3, dtype=torch.float64, device=few.points.device)[None])
    max_score = float(disagreement(residuals(itself, identity), _SCORE_WIDTH)) + MODEL.max_score_above_identity
    found = found[found.scores <= max_score].on("cpu")
    T = found.T[_distinct_symmetries(found.T, found.scores, extremal_points)]
    axis = _continuous_axis(itself, T, max_score)
    if axis is not None:
        turns = _rigid(turns_about(axis, MODEL.axis_representatives)[1:])
        T = Sim3.cat([T[~_about(T, axis)], turns])
    return SelfSymmetry(T, axis, torch.zeros(len(T)))


def confirm_symmetries(
    proposed: SelfSymmetry, obj: DistanceModel, B: Samples, extremal_points: Tensor, generator: torch.Generator
) -> SelfSymmetry:
    """The proposals refined on the object's own field, each with its deviation there.

    Costs nothing for an object without proposals, and some 4,000 field evaluations for each proposal.
    """
    if len(proposed.T) == 0:
        return proposed
    few = subsample(B, MODEL.confirming_points, generator)
    settings = Settings(scale=SAME_SCALE, normals=False)
    start = proposed.T.on(B.points.device)
    refined = minimize(SurfacePair(obj, obj, few, few), start, MODEL.confirming_widths, settings)
    deviation = (refined.sizes > MODEL.max_deviation).float().mean(1).cpu()
    found = refined.T.on("cpu")
    kept = _distinct_symmetries(found, deviation, extremal_points)
    T, deviation = found[kept], deviation[kept]
    axis = proposed.axis
    if axis is not None and bool((deviation[_about(T, axis)] > MODEL.max_deviating_share).any()):
        axis = None
    return SelfSymmetry(T, axis, deviation)


def _distinct_symmetries(T: Sim3, scores: Tensor, extremal_points: Tensor) -> Tensor:
    """Numbers of the best transforms; no two of them are alike, and none is like the identity."""
    points = extremal_points.double()
    moved = (T.apply(points) - points).norm(dim=-1).amax(-1)
    kept = distinct(T, scores, extremal_points, MODEL.min_distance, len(T) + 1)[: 2 * MODEL.max_symmetries]
    return kept[moved[kept] > MODEL.min_distance][: MODEL.max_symmetries]


def _rigid(rotations: Tensor) -> Sim3:
    """Rotations (K, 3, 3) as transforms (K,), float64."""
    rotations = rotations.double()
    return Sim3(torch.ones_like(rotations[:, 0, 0]), rotations, torch.zeros_like(rotations[:, 0]))


def _continuous_axis(itself: SurfacePair, T: Sim3, max_score: float) -> Tensor | None:
    """An axis (3,) about which every turn is a symmetry, if one of the proposals' axes is such."""
    low, high = MODEL.axis_angles
    for omega in rotation_log(T.rotation):
        angle = float(omega.norm())
        if angle < low or angle > high:
            continue
        axis: Tensor = omega / omega.norm()
        turns = _rigid(turns_about(axis, MODEL.axis_turns).to(itself.scene_samples.points.device))
        if bool((disagreement(residuals(itself, turns), _SCORE_WIDTH) <= max_score).all()):
            return axis
    return None


def _tuple(axis: Tensor) -> tuple[float, float, float]:
    """A unit vector, its largest entry positive: an axis has no direction."""
    x, y, z = (axis * axis[axis.abs().argmax()].sign()).tolist()
    return x, y, z


def _about(T: Sim3, axis: Tensor) -> Tensor:
    """(K,) bool: which of the transforms turn about the axis."""
    omega = T.log()[:, :3]
    about: Tensor = (omega @ axis).abs() >= MODEL.min_axis_cosine * omega.norm(dim=-1)
    return about


# A few outermost points of an object, by which two placements of it are compared.


def extremal_points(points: Tensor, count: int) -> Tensor:
    """``count`` of the points (N, 3), far apart from each other: farthest-point sampling from the outermost one."""
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    nearest = torch.full((points.shape[0],), torch.inf, dtype=points.dtype)
    for _ in range(min(count, points.shape[0]) - 1):
        nearest = torch.minimum(nearest, (points - points[chosen[-1]]).norm(dim=-1))
        chosen.append(int(nearest.argmax()))
    return points[chosen]


# The convex hull of an object's surface.


@dataclass(frozen=True, eq=False)
class Hull(Bundle):
    """Half-spaces: normals (F, 3) pointing outward, and offsets (F,): within, normals @ x + offsets <= 0.

    Without any, nothing is within.
    """

    normals: Tensor
    offsets: Tensor

    @classmethod
    def of(cls, points: Tensor) -> Hull:
        """The hull of points (N, 3). Points in one plane have none."""
        from scipy.spatial import ConvexHull, QhullError

        try:
            equations = torch.from_numpy(np.unique(ConvexHull(points.double().cpu().numpy()).equations, axis=0)).float()
        except QhullError:
            equations = torch.zeros(0, 4)
        equations = equations.to(points.device)
        return cls(equations[:, :3], equations[:, 3])

    def contains(self, points: Tensor, margin: float) -> Tensor:
        """(...) bool: which points (..., 3) lie within, by at least ``margin`` from every face."""
        if len(self.normals) == 0:
            return torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
        within: Tensor = (points @ self.normals.mT + self.offsets).amax(-1) <= -margin
        return within


# A shape's signature: two histograms by which shapes are compared in a millisecond.
#
# The distribution of distances between pairs of surface points (the D2 shape function, Osada et al. 2002) and that of
# point pair features (distance and the three angles between the normals and the line that joins the points, Drost et
# al. 2010), both over the root mean square distance: the same for a shape however it is turned, moved or scaled.

_FEATURE_BINS = SIGNATURE.feature_distance_bins * SIGNATURE.angle_bins**3
SIGNATURE_LENGTH = SIGNATURE.distance_bins + _FEATURE_BINS


def signature(samples: Samples) -> Tensor:
    """(310,) square roots of the shares of point pairs in each bin: first the distances, then the pair features.

    Deterministic. Square roots make the squared Euclidean distance of two signatures twice the sum of two squared
    Hellinger distances.
    """
    points, normals = samples.on_surface(), samples.normals
    generator = fixed_generator()
    i, j = torch.randint(len(samples), (2, SIGNATURE.pairs), generator=generator)
    line = points[j] - points[i]
    length = line.norm(dim=-1)
    apart = length > 1e-6
    i, j, line, length = i[apart], j[apart], line[apart], length[apart]
    direction = line / length[:, None]
    relative = length / (length.square().mean().sqrt() * SIGNATURE.max_distance)
    at_start = (direction * normals[i]).sum(-1).abs()
    at_end = (direction * normals[j]).sum(-1).abs()
    between = ((normals[i] * normals[j]).sum(-1) + 1.0) / 2.0
    bins = _bin(relative, SIGNATURE.feature_distance_bins)
    for angle in (torch.minimum(at_start, at_end), torch.maximum(at_start, at_end), between):
        bins = bins * SIGNATURE.angle_bins + _bin(angle, SIGNATURE.angle_bins)
    distances = _bin(relative, SIGNATURE.distance_bins)
    return torch.cat([_shares(distances, SIGNATURE.distance_bins), _shares(bins, _FEATURE_BINS)])


def _bin(values: Tensor, count: int) -> Tensor:
    """Which of ``count`` equal parts of 0..1 each value lies in; what lies beyond counts with the last."""
    return (values * count).long().clamp(0, count - 1)


def _shares(bins: Tensor, count: int) -> Tensor:
    counts = torch.bincount(bins, minlength=count).float()
    return (counts / counts.sum().clamp_min(1.0)).sqrt()


# What a registration needs to know of a library object beforehand: made once for a field, independent of any scene.


@dataclass(frozen=True, eq=False)
class ObjectModel(Bundle):
    """An object's surface and symmetries. Points in the working frame: the surface's centroid at 0, its diameter 1.

    spacing: between samples · extremal_points: (E, 3) outermost points, by which two placements are compared ·
    signature: (310,), see :mod:`regnf_core.robust.model` · missed: further samples, of faces of thin walls that have
    none among ``samples``.
    """

    frame: WorkingFrame
    samples: Samples
    spacing: float
    extremal_points: Tensor
    symmetry: SelfSymmetry
    signature: Tensor
    missed: Samples

    @cached_property
    def with_both_faces(self) -> ObjectModel:
        """The same with the samples of both faces of thin walls, each of which answers on its own side. Images show one
        of the two; a complete map shows both, and there one is enough."""
        model = replace(self, samples=Samples.cat([self.samples, self.missed]))
        model.__dict__["distance_grid"] = distance_grid(model.samples, model.spacing, thin=True)
        return model

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64, the object's frame: of the samples."""
        points = self.frame.out_of(self.samples.on_surface())
        return torch.stack([points.amin(0), points.amax(0)])

    @cached_property
    def distance_grid(self) -> DistanceGrid:
        """Distances to the samples, on a grid."""
        return distance_grid(self.samples, self.spacing)

    @cached_property
    def hull(self) -> Hull:
        """The samples' convex hull."""
        return Hull.of(self.samples.on_surface())

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
    samples, missed = sampled.samples, sampled.missed
    assert missed is not None  # an object's are looked for
    outermost = extremal_points(samples.on_surface(), MODEL.extremal_points)
    device = working_device(obj)
    there, rotations = samples.on(device), super_fibonacci(MODEL.rotations).to(device)
    grid = distance_grid(there, sampled.spacing)
    proposed = propose_symmetries(grid, there, outermost, rotations, generator)
    symmetry = confirm_symmetries(proposed, sampled.field, there, outermost, generator).on("cpu")
    sampled.field.require_finite()
    model = ObjectModel(sampled.frame, samples, sampled.spacing, outermost, symmetry, signature(samples), missed)
    model.__dict__["distance_grid"] = grid.on("cpu")  # what the property would make again
    return model


# An object's model as a safetensors file of about 50 kB, which saves sampling the object again.

MODEL_VERSION = "3"
"""Raised whenever models made by older code must be made again."""
_SHAPES = {
    "center": "3",
    "lengths": "2",
    "points": "N 3",
    "values": "N",
    "normals": "N 3",
    "extremes": "E 3",
    "symmetry.scale": "K",
    "symmetry.rotation": "K 3 3",
    "symmetry.translation": "K 3",
    "symmetry.deviation": "K",
    "symmetry.axis": "A 3",
    "signature": str(SIGNATURE_LENGTH),
    "missed.points": "M 3",
    "missed.values": "M",
    "missed.normals": "M 3",
}
"""By the tensors' names. A letter stands for the same count wherever it appears."""


def write_object_model(path: str | os.PathLike[str], model: ObjectModel) -> None:
    """Write the model atomically."""
    axis = model.symmetry.axis
    values = (
        model.frame.center,
        torch.tensor([model.frame.length, model.spacing], dtype=torch.float64),
        *(model.samples.points, model.samples.values, model.samples.normals, model.extremal_points),
        *(model.symmetry.T.scale, model.symmetry.T.rotation, model.symmetry.T.translation, model.symmetry.deviation),
        axis[None] if axis is not None else torch.zeros(0, 3),
        model.signature,
        *(model.missed.points, model.missed.values, model.missed.normals),
    )
    tensors = {name: tensor.contiguous() for name, tensor in zip(_SHAPES, values, strict=True)}
    content = save(tensors, {"regnf_object_model": MODEL_VERSION})
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def read_object_model(path: str | os.PathLike[str]) -> ObjectModel:
    """The model in a file that :func:`write_object_model` wrote.

    Raises FieldFormatError (OBJECT_MODEL_INVALID), also for a file of another version: make the model again.
    """
    try:
        with safe_open(os.fspath(path), framework="pt") as file:
            version = (file.metadata() or {}).get("regnf_object_model")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise _invalid(f"not a safetensors file: {error}") from error
    if version != MODEL_VERSION:
        raise _invalid(f"version {json.dumps(version)[:20]}, expected {MODEL_VERSION}")
    _check(tensors)
    center, lengths = tensors["center"].double(), tensors["lengths"].double()
    T = Sim3(*(tensors[f"symmetry.{part}"].double() for part in ("scale", "rotation", "translation")))
    axes = tensors["symmetry.axis"]
    return ObjectModel(
        WorkingFrame(center, float(lengths[0])),
        Samples(*(tensors[name].float() for name in ("points", "values", "normals"))),
        float(lengths[1]),
        tensors["extremes"].float(),
        SelfSymmetry(T, axes[0].double() if len(axes) else None, tensors["symmetry.deviation"].float()),
        tensors["signature"].float(),
        Samples(*(tensors[f"missed.{name}"].float() for name in ("points", "values", "normals"))),
    )


def _check(tensors: dict[str, Tensor]) -> None:
    """Names, shapes and finite numbers."""
    if tensors.keys() != _SHAPES.keys():
        raise _invalid(f"unexpected or missing tensors: {sorted(tensors.keys() ^ _SHAPES.keys())[:4]}")
    counts: dict[str, int] = {}
    for name, shape in _SHAPES.items():
        parts, found = shape.split(), list(tensors[name].shape)
        expected = [int(p) if p.isdigit() else counts.setdefault(p, n) for p, n in zip(parts, found, strict=False)]
        finite = tensors[name].is_floating_point() and bool(torch.isfinite(tensors[name]).all())
        if found != expected or len(found) != len(parts) or not finite:
            raise _invalid(f"{name} has shape {found} or numbers that are not finite")
    if counts["N"] == 0 or counts["E"] == 0 or counts["A"] > 1 or not (tensors["lengths"] > 0).all():
        raise _invalid("no samples, or lengths that are not positive")


def _invalid(detail: str) -> FieldFormatError:
    return FieldFormatError(f"the object's model: {detail}", reason="OBJECT_MODEL_INVALID")
