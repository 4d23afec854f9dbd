"""Fitting a neus-facto field to an exact signed distance field."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.build import open_field
from regnf_core.fields.transformed import TransformedField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.safe_format import write_safe_field
from regnf_fit.local_frame import LocalFrame
from regnf_fit.mesh.options import FitOptions, FitReport
from regnf_fit.mesh.samples import ExactSamples, diagonal, near_samples, padded_bounds, volume_samples
from regnf_fit.network import GRID_RADIUS, StartShape, TrainableField, make_optimizer
from regnf_fit.options import FitProgress

_CHECK_POINTS = 20_000
_REPORT_EVERY = 50


def fit_field(
    target: SdfField,
    path: str | os.PathLike[str],
    options: FitOptions | None = None,
    seed: int = 0,
    progress: FitProgress | None = None,
    label: str | None = None,
    source: dict[str, Any] | None = None,
) -> FitReport:
    """Fit a field to ``target``, write it to ``path`` in the safe format, and say how well it agrees.

    The target's frame is kept: where its padded bounds reach beyond [-2, 2]^3, the hash grid's cube, it is fitted in a
    frame of its own, and placed. Deterministic for ``seed`` on one machine.
    Raises InvalidInputError (NO_SURFACE_IN_TARGET).
    """
    options = options or FitOptions()
    frame = LocalFrame.in_grid(padded_bounds(target, options.padding).numpy(), GRID_RADIUS)
    T_target_local = Sim3.from_matrix(frame.T_world_local.tolist())
    target = target if frame.same else TransformedField(target, T_target_local)
    started = time.monotonic()
    rng = np.random.default_rng(seed)
    near = near_samples(target, options.near_points, options.noise, rng)
    volume = volume_samples(target, options.volume_points, options.padding, rng)
    trained = _train(target, near, volume, options, seed, progress)
    description = trained.description(padded_bounds(target, options.margin), label, source or {})
    write_safe_field(path, frame.leave(description), trained.tensors())
    field = open_field(path) if frame.same else TransformedField(open_field(path), T_target_local)
    report = measure_fit(field, target, options, seed + 1, time.monotonic() - started)
    return replace(report, diagonal=report.diagonal / frame.scale)


def measure_fit(field: SdfField, target: SdfField, options: FitOptions, seed: int, seconds: float) -> FitReport:
    """How well ``field`` agrees with ``target`` on fresh points, drawn as the options say."""
    rng = np.random.default_rng(seed)
    near = near_samples(target, _CHECK_POINTS, options.noise, rng)
    volume = volume_samples(target, _CHECK_POINTS, options.padding, rng)
    size = diagonal(target)
    distance, gradient = field.signed_distance_and_gradient(near.points)
    error = (distance - near.distances).abs() / size
    free = near.distances > 0.0
    norm = gradient[free].norm(dim=-1)
    cosine = (gradient[free] * near.gradients[free]).sum(dim=-1) / norm.clamp_min(1e-9)
    return FitReport(
        mean_error=float(error.mean()),
        p95_error=float(error.quantile(0.95)),
        max_error=float(error.max()),
        volume_mean_error=float((field.signed_distance(volume.points) - volume.distances).abs().mean()) / size,
        mean_gradient_norm=float(norm.mean()),
        mean_normal_cosine=float(cosine.mean()),
        diagonal=size,
        iterations=options.iterations,
        seconds=seconds,
    )


def _train(
    target: SdfField,
    near: ExactSamples,
    volume: ExactSamples,
    options: FitOptions,
    seed: int,
    progress: FitProgress | None,
) -> TrainableField:
    generator = torch.Generator().manual_seed(seed)
    size = diagonal(target)
    network = TrainableField(options, StartShape(torch.zeros(3), radius=size / 4.0), generator)
    optimizer = make_optimizer(network.table, [*network.weights, *network.biases], options)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, options.rate_share)
    started = time.monotonic()
    for iteration in range(1, options.iterations + 1):
        loss = _loss(network, near, volume, options, size, generator)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        if progress is not None and (iteration % _REPORT_EVERY == 0 or iteration == options.iterations):
            spent = time.monotonic() - started
            progress(iteration, float(loss.detach()), spent / iteration * (options.iterations - iteration))
    return network


def _loss(
    network: TrainableField,
    near: ExactSamples,
    volume: ExactSamples,
    options: FitOptions,
    size: float,
    generator: torch.Generator,
) -> Tensor:
    """Mean |distance error| in diagonals, plus the weighted squared error of the gradient near the surface."""
    function = network.function()
    from_volume = options.batch // 3
    close = _draw(near, options.batch - from_volume, generator)
    far = _draw(volume, from_volume, generator)
    values = function.value(torch.cat((close.points, far.points)))
    loss = (values - torch.cat((close.distances, far.distances))).abs().mean() / size
    if options.gradient_batch > 0:
        slopes = _draw(near, options.gradient_batch, generator)
        distance, gradient = function.value_and_gradient(slopes.points)
        loss = loss + (distance - slopes.distances).abs().mean() / size
        loss = loss + options.gradient_weight * (gradient - slopes.gradients).square().sum(dim=-1).mean()
    return loss


def _draw(samples: ExactSamples, count: int, generator: torch.Generator) -> ExactSamples:
    return samples.take(torch.randint(len(samples), (count,), generator=generator))
