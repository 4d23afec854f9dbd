"""How much a network, read in one of several ways, behaves like a signed distance: measured at few points."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.base import SdfField
from regnf_core.fields.build import build_field
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.schema.parsing import parse_description
from regnf_core.schema.safe_format import tensor_specs
from regnf_core.surface.projection import newton_step

QUICK_SAMPLES, SAMPLES, COMPARED = 512, 2048, 1024
_NEAREST_SHARE = 8
_STEPS = 6
_BAND = 0.02
"""How far from the surface the gradient is looked at, of the bounds' diagonal."""
_REACHES = (0.03, 0.06, 0.12, 0.2, 0.35)
"""Half widths of the bands in which values are compared with distances, of the bounds' diagonal."""
_ARRIVED = 1e-4
_FEWEST = 24
_CONE = 0.9


@dataclass(frozen=True)
class Trial:
    """A reading, built. misfit: how far the gradient's length is from 1 near the surface, mean, at most 1; infinite
    where there is no surface or no sound number."""

    reading: Reading
    field: SdfField | None
    misfit: float


@without_new_code()
def quick_trial(reading: Reading) -> Trial:
    """Of the points that are nearest to the surface of a few hundred."""
    field = _built(reading)
    if field is None:
        return Trial(reading, None, math.inf)
    points = _in_bounds(field, QUICK_SAMPLES)
    distance = field.signed_distance(points)
    nearest = points[distance.abs().argsort()[: QUICK_SAMPLES // _NEAREST_SHARE]]
    return Trial(reading, field, _misfit(field.signed_distance_and_gradient(nearest)[1]))


@without_new_code()
def full_trial(trial: Trial) -> Trial:
    """On the surface and in a narrow band round it."""
    if trial.field is None:
        return trial
    surface, normal = surface_points(trial.field)
    if len(surface) < _FEWEST:
        return Trial(trial.reading, trial.field, math.inf)
    reach = _BAND * _diagonal(trial.field)
    offset = reach * (2.0 * torch.rand(len(surface), 1, generator=torch.Generator().manual_seed(2)) - 1.0)
    gradient = trial.field.signed_distance_and_gradient(surface + offset * normal)[1]
    return Trial(trial.reading, trial.field, _misfit(gradient))


@without_new_code()
def surface_points(field: SdfField) -> tuple[Tensor, Tensor]:
    """Points (M, 3) of the surface within the bounds, with unit normals; none where all values have one sign."""
    points = _in_bounds(field, SAMPLES)
    distance = field.signed_distance(points)
    nearest = points[distance.abs().argsort()[: SAMPLES // _NEAREST_SHARE]]
    low, high = field.bounds[0].float(), field.bounds[1].float()
    longest = _diagonal(field) / 20.0
    for _ in range(_STEPS):
        value, gradient = field.signed_distance_and_gradient(nearest)
        step = newton_step(value, gradient, 1e-6)
        step = step / (step.norm(dim=-1, keepdim=True) / longest).clamp_min(1.0)
        nearest = torch.minimum(torch.maximum(nearest - step, low), high)
    value, gradient = field.signed_distance_and_gradient(nearest)
    length = gradient.norm(dim=-1)
    arrived = (value.abs() < _ARRIVED * _diagonal(field) * length) & (length > 1e-6) & length.isfinite()
    return nearest[arrived], gradient[arrived] / length[arrived, None]


@without_new_code()
def distance_errors(field: SdfField) -> list[float]:
    """By how much values differ from the distance to the zero level, median, of it, in shells of growing reach.

    The distance is that to the tangent planes of points of the zero level.
    """
    surface, normal = surface_points(field)
    points = _in_bounds(field, COMPARED)
    if len(surface) < _FEWEST:
        return [math.inf] * len(_REACHES)
    diagonal = _diagonal(field)
    near = torch.cat([surface + h * diagonal * normal for h in (-0.1, -0.05, -0.025, 0.025, 0.05, 0.1)])
    points = torch.cat((points, near))
    nearest = torch.cdist(points, surface).argmin(dim=1)
    distance = ((points - surface[nearest]) * normal[nearest]).sum(dim=-1)
    value = field.signed_distance(points)
    errors = []
    for reach in _REACHES:
        far = reach * diagonal
        shell = (distance.abs() > far / 2.0) & (distance.abs() < far)
        few = int(shell.sum()) < _FEWEST
        relative = (value - distance)[shell] / distance[shell]
        errors.append(math.inf if few else float(relative.abs().median()))
    return errors


@without_new_code()
def end_of_training(field: SdfField) -> tuple[float, float]:
    """The radius beyond which the gradient's length is no longer 1, along the axes, and how clearly it ends there.

    Clearly: the least misfit in the shells beyond, over the greatest in those within.
    """
    edges = 0.25 * 1.08 ** torch.arange(46)
    generator = torch.Generator().manual_seed(3)
    misfits = []
    for low, high in itertools.pairwise(edges):
        direction = torch.randn(600, 3, generator=generator)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        direction = direction[direction.abs().amax(dim=-1) > _CONE]
        radius = low + (high - low) * torch.rand(len(direction), 1, generator=generator)
        lengths = field.signed_distance_and_gradient(radius * direction)[1].norm(dim=-1)
        misfits.append(float((lengths - 1.0).abs().median()))
    within, beyond = 4, 6
    contrast = {
        float(edges[i]): min(misfits[i + 1 : i + beyond]) / max(1e-4, *misfits[i - within : i])
        for i in range(within, len(misfits) - beyond)
    }
    radius = max(contrast, key=contrast.__getitem__)
    return radius, contrast[radius]


@without_new_code()
def values_differ(one: SdfField, other: SdfField, share: float) -> bool:
    """Whether the two fields' values differ by more than ``share`` of their range, within the first one's bounds."""
    points = _in_bounds(one, COMPARED)
    a, b = one.signed_distance(points), other.signed_distance(points)
    return bool((a - b).abs().max() > share * (a.max() - a.min()))


def _built(reading: Reading) -> SdfField | None:
    try:
        description = parse_description(reading.description)
        description.check(tensor_specs(reading.tensors))
        with warnings.catch_warnings():
            # the map of the upload is only read
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")
            tensors = {name: torch.from_numpy(array) for name, array in reading.tensors.items()}
        return build_field(description, tensors)
    except FieldFormatError:  # a factor beyond what a field may have
        return None


def _in_bounds(field: SdfField, count: int) -> Tensor:
    low, high = field.bounds[0].float(), field.bounds[1].float()
    return low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(1))


def _diagonal(field: SdfField) -> float:
    return float((field.bounds[1] - field.bounds[0]).norm())


def _misfit(gradient: Tensor) -> float:
    lengths = gradient.norm(dim=-1)
    return float((lengths - 1.0).abs().nan_to_num(1.0).clamp_max(1.0).mean())
