"""Fitting a neural field to an exact one."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.build import open_field
from regnf_core.fields.composite import SurfaceSource, TransformedField
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.importing.mesh_file import load_solid
from regnf_core.schema.safe_format import write_safe_field
from regnf_fit.local_frame import LocalFrame
from regnf_fit.network import GRID_RADIUS, StartShape, TrainableField, make_optimizer
from regnf_fit.options import FitOptions, FitProgress, FitReport

# A mesh file as the target of a fit.


class MeshTarget(NamedTuple):
    """field: the mesh, scaled if that was requested · source: where it came from, as the fitted field records it."""

    field: MeshField
    source: dict[str, Any]


def mesh_target(mesh: Path, extent: float | None = None, node: str | None = None) -> MeshTarget:
    """The mesh in a file; with ``extent`` moved to the origin and scaled so that its longest edge has this length.

    node: of a scene, the node to read. Faces are turned as an upload's are; the source's ``mesh_faces`` says what was
    done to them, if anything. Raises what ``load_solid`` does.
    """
    target, done = load_solid(mesh, node=node)
    source: dict[str, Any] = {"mesh": mesh.name, **({"mesh_faces": list(done)} if done else {})}
    if extent is None:
        return MeshTarget(target, source)
    low, high = target.bounds.numpy()
    T_field_mesh = np.eye(4)
    T_field_mesh[:3, :3] *= extent / (high - low).max()
    T_field_mesh[:3, 3] = -T_field_mesh[0, 0] * (low + high) / 2
    return MeshTarget(target.transformed(T_field_mesh), {**source, "T_field_mesh": T_field_mesh.tolist()})


# The pool of exact distances that a field is fitted to.

_PROJECTION_STEPS = 3


@dataclass(frozen=True)
class ExactSamples:
    """Points (N, 3) with their exact signed distances (N,) and gradients (N, 3), target frame."""

    points: Tensor
    distances: Tensor
    gradients: Tensor

    def drawn(self, count: int, generator: torch.Generator) -> ExactSamples:
        """Some of them, any as often as another."""
        index = torch.randint(len(self.points), (count,), generator=generator)
        return ExactSamples(self.points[index], self.distances[index], self.gradients[index])


def diagonal(target: SdfField) -> float:
    """Length of the space diagonal of the target's bounds, own units."""
    lower, upper = target.bounds
    return float((upper - lower).norm())


def padded_bounds(target: SdfField, padding: float) -> Tensor:
    """(2, 3) float64: the target's bounds grown on every side by ``padding`` diagonals."""
    grow = padding * diagonal(target)
    return target.bounds + torch.tensor([[-grow], [grow]], dtype=torch.float64)


def near_samples(target: SdfField, count: int, noise: tuple[float, ...], rng: np.random.Generator) -> ExactSamples:
    """About ``count`` samples around the surface: surface points with Gaussian noise of several scales, as
    diagonals."""
    surface = _surface_points(target, count, rng)
    scales = diagonal(target) * rng.choice(noise, size=(len(surface), 1))
    return _measure(target, surface + scales * rng.standard_normal(surface.shape))


def volume_samples(target: SdfField, count: int, padding: float, rng: np.random.Generator) -> ExactSamples:
    """``count`` samples uniform in the padded bounds."""
    lower, upper = padded_bounds(target, padding).numpy()
    return _measure(target, rng.uniform(lower, upper, size=(count, 3)))


def _measure(target: SdfField, points: NDArray[np.float64]) -> ExactSamples:
    queries = torch.from_numpy(points.astype(np.float32))
    distances, gradients = target.signed_distance_and_gradient(queries)
    return ExactSamples(queries, distances.cpu(), gradients.cpu())


def _surface_points(target: SdfField, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Surface points (M, 3): the target's own, or else points of its bounds carried down its gradient."""
    if isinstance(target, TransformedField) and isinstance(target.field, SurfaceSource):
        points = torch.from_numpy(_surface_points(target.field, count, rng))
        moved: NDArray[np.float64] = target.T_field_frame.inverse().apply(points).numpy()
        return moved
    if isinstance(target, SurfaceSource):
        if not target.area > 0.0:
            raise InvalidInputError("the target's surface has no area", reason="NO_SURFACE_IN_TARGET")
        return target.sample_surface(count, rng)
    points = volume_samples(target, count, 0.05, rng).points
    for _ in range(_PROJECTION_STEPS):
        distance, gradient = target.signed_distance_and_gradient(points)
        points = points - distance[:, None] * gradient
    arrived = target.signed_distance(points).abs() < 1e-3 * diagonal(target)
    if not arrived.any():
        raise InvalidInputError("the target has no surface within its bounds", reason="NO_SURFACE_IN_TARGET")
    surface: NDArray[np.float64] = points[arrived].double().numpy()
    return surface


# Fitting a neus-facto field to an exact signed distance field.

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
    networks = [*network.weights, *network.biases]
    optimizer = make_optimizer(network.table, networks, options.table_rate, options.network_rate)
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
    close = near.drawn(options.batch - from_volume, generator)
    far = volume.drawn(from_volume, generator)
    values = function.value(torch.cat((close.points, far.points)))
    loss = (values - torch.cat((close.distances, far.distances))).abs().mean() / size
    if options.gradient_batch > 0:
        slopes = near.drawn(options.gradient_batch, generator)
        distance, gradient = function.value_and_gradient(slopes.points)
        loss = loss + (distance - slopes.distances).abs().mean() / size
        loss = loss + options.gradient_weight * (gradient - slopes.gradients).square().sum(dim=-1).mean()
    return loss
