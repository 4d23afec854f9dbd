"""One fit: the field, what it is fitted to, and the state between two iterations."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.geometry.exponential_map import rotation_exp
from regnf_data.posed_images import PosedImages
from regnf_fit.images.coloring import RadianceField
from regnf_fit.images.depth_supervision import DepthSupervision, depth_terms, supervise
from regnf_fit.images.fusion import MapDistances
from regnf_fit.images.observing import DepthSpread
from regnf_fit.images.preparation import PixelRays, PreparedImages
from regnf_fit.network import make_optimizer
from regnf_fit.options import ReconstructionOptions

# Small corrections of the cameras' poses, learned with the field.
#
# As Wang et al. (2021, "NeRF--: Neural Radiance Fields Without Known Camera Parameters") and Azinovic et al. (2022,
# "Neural RGB-D Surface Reconstruction"), but held to the poses that are given by a prior of the size that the images'
# own contradictions have: a correction is a rotation about the camera and a shift of it. Their mean is zero, so that
# the frame is that of all the given poses: that of one image would have the errors of that image.


def expected_errors(spread: DepthSpread, size: float) -> tuple[float, float]:
    """Standard deviations of the given poses' turns, radians, and shifts, field units: those that would make depths of
    one surface contradict each other as much as they do, each by itself.

    size: of the bounds' diagonal; where the spread is not known, a thousandth of it.
    """
    if len(spread.depths) == 0:
        return 1e-3, 1e-3 * size
    shift = float(np.median(spread.deviations))
    return shift / float(np.median(spread.depths)), shift


class CameraPoses(nn.Module):
    """A correction for each of N images. turn, shift: as of :func:`expected_errors`."""

    def __init__(self, images: int, turn: float, shift: float) -> None:
        super().__init__()
        self.steps = nn.Parameter(torch.zeros(images, 6))
        """Rotation vectors and shifts (N, 6) in world axes, in the deviations that are expected. Their mean does not
        count."""
        self.register_buffer("unit", torch.tensor([turn] * 3 + [shift] * 3, dtype=torch.float32))

    def corrections(self) -> tuple[Tensor, Tensor]:
        """Rotations (N, 3, 3) about the cameras and their shifts (N, 3), world axes."""
        steps = (self.steps - self.steps.mean(0)) * self.get_buffer("unit")
        return rotation_exp(steps[:, :3]), steps[:, 3:]

    def correct(self, rays: PixelRays) -> PixelRays:
        """The rays of the corrected cameras, differentiable."""
        turns, shifts = self.corrections()
        directions = (turns[rays.images] @ rays.directions[..., None]).squeeze(-1)
        return replace(rays, origins=rays.origins + shifts[rays.images], directions=directions)

    @torch.no_grad()
    def median_shift(self) -> float:
        """Of all cameras, field units."""
        return float(self.corrections()[1].norm(dim=1).median())

    @torch.no_grad()
    def corrected(self, images: PosedImages) -> PosedImages:
        turns, shifts = (part.double().cpu().numpy() for part in self.corrections())
        poses: NDArray[np.float64] = images.T_world_camera.copy()
        poses[:, :3, :3] = turns @ poses[:, :3, :3]
        poses[:, :3, 3] += shifts
        return replace(images, T_world_camera=poses)


# Opacity along rays from signed distances (Wang et al. 2021, "NeuS").


def render_weights(distances: Tensor, sharpness: Tensor | float) -> tuple[Tensor, Tensor]:
    """What each of a ray's S - 1 sections counts, (R, S - 1), and what passes all of them, (R,).

    distances: (R, S), signed distances at consecutive points of each ray · sharpness: s of the logistic function, per
    field unit. Equation 13, alpha_i = max((Phi_s(f_i) - Phi_s(f_i+1)) / Phi_s(f_i), 0), in logarithms, so that a point
    deep in matter does not divide by zero: what passes sections 1 to i is the product of their 1 - alpha.
    Weights and rest sum to 1.
    """
    logarithm = logsigmoid(sharpness * distances)
    passed = (logarithm[:, 1:] - logarithm[:, :-1]).clamp_max(0.0).cumsum(dim=1).exp()
    before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1]), dim=1)
    return before - passed, passed[:, -1]


def least_sharpness(share: float, size: float) -> float:
    """The sharpness below which the learned one may not fall after ``share`` of the fit, per field unit.

    It grows from 20 to 400 over the diagonal ``size``: blurred at first, so that every section on a ray learns, and at
    last narrower than a hundredth of the diagonal whatever was learned.
    """
    return 20.0 * math.exp(math.log(20.0) * min(max(share, 0.0), 1.0)) / size


# Color, depth and opacity of rays, rendered through the field.

_COLORED_SECTIONS = 3
"""On each ray the color is evaluated in so many sections, those that count most."""
_FREE_SAMPLES = 5
_BAND_SAMPLES = 9
_EVEN_SAMPLES = 24


@dataclass(frozen=True)
class Rendered:
    """Of R rays: colors (R, 3) in [0, 1], as they lie before ``background`` · depths (R,) along the camera's axis,
    of what is opaque · opacity (R,) in [0, 1]."""

    colors: Tensor
    depths: Tensor
    opacity: Tensor


def render_rays(
    field: RadianceField,
    rays: PixelRays,
    depths: Tensor,
    sharpness: Tensor,
    background: Tensor,
    geometry_learns: bool = True,
) -> Rendered:
    """Render rays through samples at ``depths`` (R, S), ascending; background: (3,) the color behind everything.

    Differentiable by the field's parameters. Normals given to the color's network are not differentiated: the
    geometry learns from the opacity. geometry_learns: False leaves all of it out, but for the sharpness.
    """
    function = field.function()
    learning = geometry_learns and torch.is_grad_enabled()
    with torch.set_grad_enabled(learning):
        distances = function.value(rays.at(depths).flatten(0, 1)).view_as(depths)
    weights, rest = render_weights(distances, sharpness)
    middles = (depths[:, 1:] + depths[:, :-1]) / 2.0
    opacity = 1.0 - rest
    heaviest = weights.detach().topk(min(_COLORED_SECTIONS, weights.shape[1]), dim=1).indices
    points = rays.at(middles.gather(1, heaviest))  # (R, K, 3)
    directions = torch.nn.functional.normalize(rays.directions, dim=1)[:, None].expand_as(points)
    flat = points.flatten(0, 1)
    with torch.no_grad():
        normals = torch.nn.functional.normalize(function.value_and_gradient(flat)[1], dim=1)
    with torch.set_grad_enabled(learning):
        hidden = function.mlp.hidden(function.encode(flat))
    colors = field.color(flat, directions.flatten(0, 1), normals, field.feature(hidden)).view_as(points)
    chosen = weights.gather(1, heaviest)
    share = chosen / chosen.sum(dim=1, keepdim=True).clamp_min(1e-6)  # the sections left out are colored alike
    color = opacity[:, None] * (share[..., None] * colors).sum(dim=1) + rest[:, None] * background
    depth = (weights * middles).sum(dim=1) / opacity.clamp_min(1e-6)
    return Rendered(color, depth, opacity)


def samples_about_depth(rays: PixelRays, bands: Tensor, generator: torch.Generator) -> Tensor:
    """(R, S) ascending depths: a few in free space, the others within ``bands`` (R,), field units, of the
    measured depth."""
    half = (bands / rays.directions.norm(dim=1))[:, None]
    measured = rays.depths[:, None]
    start = torch.minimum(rays.near[:, None], measured - 2.0 * half)
    free = start + (measured - half - start) * _stratified(len(rays), _FREE_SAMPLES, generator).to(half.device)
    close = measured - half + 2.0 * half * _stratified(len(rays), _BAND_SAMPLES, generator).to(half.device)
    return torch.cat((free, close), dim=1)


@torch.no_grad()
def samples_by_weight(
    function: NeusFactoFunction, rays: PixelRays, sharpness: Tensor, generator: torch.Generator
) -> Tensor:
    """(R, S) ascending depths within the bounds: an even half, and a half where the field's own weights are large.

    Importance sampling as in NeuS: the field is its own proposal.
    """
    span = (rays.far - rays.near)[:, None]
    even = rays.near[:, None] + span * _stratified(len(rays), _EVEN_SAMPLES, generator).to(span.device)
    weights, _ = render_weights(function.value(rays.at(even).flatten(0, 1)).view_as(even), sharpness)
    edges = torch.nn.functional.pad(torch.cumsum(weights + 1e-4, dim=1), (1, 0))
    edges = edges / edges[:, -1:]
    places = _stratified(len(rays), _EVEN_SAMPLES, generator).to(span.device)
    section = (torch.searchsorted(edges, places, right=True) - 1).clamp(0, weights.shape[1] - 1)
    low, high = edges.gather(1, section), edges.gather(1, section + 1)
    start, end = even.gather(1, section), even.gather(1, section + 1)
    chosen = start + (places - low) / (high - low).clamp_min(1e-9) * (end - start)
    return torch.cat((even, chosen), dim=1).sort(dim=1).values


def _stratified(rays: int, count: int, generator: torch.Generator) -> Tensor:
    return (torch.arange(count) + torch.rand(rays, count, generator=generator)) / count


_SHARPEST = 50.0
"""How far above the least sharpness the learned one may rise."""
_SHARPNESS_RATE = 5.0
"""The sharpness learns so much faster than the networks: it is one number with far to go."""

_COLOR_EVERY = 8
"""Where the geometry does not learn from colors, they learn in one of so many iterations."""


class Trainer:
    """Fits a :class:`RadianceField`; everything random comes from one generator, so that a state can be resumed."""

    def __init__(
        self,
        prepared: PreparedImages,
        options: ReconstructionOptions,
        seed: int,
        device: torch.device,
        rng: np.random.Generator,
        near: MapDistances | None = None,
    ) -> None:
        self.options = options
        self.iteration = 0
        self._losses: list[Tensor] = []
        self.generator = torch.Generator().manual_seed(seed)
        self.field = RadianceField(options, prepared.start, self.generator).to(device)
        self.averaged = copy.deepcopy(self.field).requires_grad_(False)
        """The moving average of ``field``: what is worth writing while the learning rates are still high."""
        self._level_ends = list(itertools.accumulate(options.grid.level_entries()))
        self._size = prepared.size
        self._rays = prepared.training.to(device)
        self._data: DepthSupervision | None = None
        if prepared.has_depth:
            self._data = replace(supervise(prepared, options, rng), near=near).to(device)
        self._masked = bool(prepared.training.background.any())
        self._bounds = prepared.bounds.float().to(device)
        self._device = device
        field = self.field
        networks = [*field.weights, *field.biases, *field.color_weights, *field.color_biases]
        networks += [field.feature_weight, field.feature_bias, field.background]
        sharpness = {"params": [field.log_sharpness], "lr": _SHARPNESS_RATE * options.network_rate}
        self.optimizer = make_optimizer(field.table, networks, options.table_rate, options.network_rate, sharpness)
        self.poses: CameraPoses | None = None
        if options.refine_poses and prepared.has_depth:
            self.poses = CameraPoses(prepared.images, *expected_errors(prepared.spread, prepared.size)).to(device)
            self.optimizer.add_param_group({"params": [self.poses.steps], "lr": options.pose_rate})
        self._rates = [group["lr"] for group in self.optimizer.param_groups]

    @property
    def learns_color(self) -> bool:
        """Whether the color's network is fitted at all."""
        return self._data is None or self.options.color_rays > 0

    def mean_loss(self) -> float:
        """Of the iterations since the last call; NaN before the first."""
        losses, self._losses = self._losses, []
        return float(torch.stack(losses).mean()) if losses else math.nan

    def is_finite(self) -> bool:
        """Whether all parameters are numbers."""
        return all(bool(torch.isfinite(parameter).all()) for parameter in self.field.parameters())

    def step(self) -> None:
        share = self.options.rate_share(self.iteration)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * share
        loss = self._loss()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        # Coarse to fine, as Li et al. (2023, "Neuralangelo"): a level that does not learn yet stays next to zero.
        levels = self.options.learning_levels(self.iteration)
        if self.field.table.grad is not None and levels < len(self._level_ends):
            self.field.table.grad[self._level_ends[levels - 1] :] = 0.0
        self.optimizer.step()
        with torch.no_grad():
            self.field.log_sharpness.clamp_(0.0, math.log(_SHARPEST))
            keep = self.options.decay(self.iteration)
            for average, parameter in zip(self.averaged.parameters(), self.field.parameters(), strict=True):
                average.lerp_(parameter, 1.0 - keep)
        self.iteration += 1
        self._losses.append(loss.detach())

    def sharpness(self) -> Tensor:
        """The opacity's sharpness now, per field unit."""
        least = least_sharpness(self.iteration / self.options.iterations, self._size)
        return least * self.field.log_sharpness.exp()

    def _loss(self) -> Tensor:
        weights = self.options.weights
        function = self.field.function()
        if self._data is None:
            loss, near = self._color_alone()
            return loss + weights.eikonal * self._eikonal(function, near)
        surface, free_space, near = depth_terms(function, self._data, self.options, self.generator, self._correct)
        of_surface = weights.surface if self.poses is None else weights.surface_with_poses
        of_surface = of_surface if self._data.near is None else weights.map
        loss = of_surface * surface + weights.free_space * free_space
        if (poses := self._learning_poses()) is not None:
            loss = loss + weights.poses * poses.steps.square().mean()
        loss = loss + weights.eikonal * self._eikonal(function, near)
        if self.options.color_rays > 0 and (self.poses is not None or self.iteration % _COLOR_EVERY == 0):
            loss = loss + self._color(self._data)
        return loss

    def _learning_poses(self) -> CameraPoses | None:
        """The poses, where they are corrected in this iteration."""
        return self.poses if self.iteration >= self.options.poses_from * self.options.iterations else None

    def _correct(self, rays: PixelRays) -> PixelRays:
        poses = self._learning_poses()
        return rays if poses is None else poses.correct(rays)

    def _eikonal(self, function: NeusFactoFunction, near: Tensor) -> Tensor:
        half = self.options.eikonal_points // 2
        chosen = torch.randint(len(near), (half,), generator=self.generator).to(self._device)
        anywhere = torch.rand(half, 3, generator=self.generator).to(self._device)
        anywhere = self._bounds[0] + anywhere * (self._bounds[1] - self._bounds[0])
        _, gradient = function.value_and_gradient(torch.cat((near[chosen], anywhere)))
        loss: Tensor = (gradient.norm(dim=1) - 1.0).square().mean()
        return loss

    def _color(self, data: DepthSupervision) -> Tensor:
        """Color and rendered depth of rays with depth, L1 both: for colors and sharpness, and where poses are corrected
        for them and the geometry."""
        options = self.options
        index = torch.randint(len(data.rays), (options.color_rays,), generator=self.generator).to(self._device)
        rays = self._correct(data.rays.take(index))
        depths = samples_about_depth(rays, 2.0 * data.before[index], self.generator)
        background = self.field.background.sigmoid()
        rendered = render_rays(self.field, rays, depths, self.sharpness(), background, self.poses is not None)
        color = (rendered.colors - rays.colors).abs().mean()
        depth = (rendered.depths - rays.depths).abs().mean() / data.size
        return options.weights.color * color + options.weights.rendered_depth * depth

    def _color_alone(self) -> tuple[Tensor, Tensor]:
        """The terms of rays without depth, and points (N, 3) close to where they end."""
        weights = self.options.weights
        index = torch.randint(len(self._rays), (self.options.rays_without_depth,), generator=self.generator)
        rays, sharpness = self._rays.take(index.to(self._device)), self.sharpness()
        depths = samples_by_weight(self.field.function(), rays, sharpness.detach(), self.generator)
        rendered = render_rays(self.field, rays, depths, sharpness, self.field.background.sigmoid())
        error = (rendered.colors - rays.colors).abs().mean(dim=1)
        # what lies behind a masked object has no color of its own
        loss = weights.color * error[~rays.background].sum() / len(rays)
        if self._masked:
            wanted = (~rays.background).float()
            opacity = rendered.opacity.clamp(1e-4, 1.0 - 1e-4)
            loss = loss + weights.opacity * torch.nn.functional.binary_cross_entropy(opacity, wanted)
        return loss, rays.at(rendered.depths.detach()[:, None])[:, 0]

    def _parts(self) -> dict[str, Any]:
        parts = {"field": self.field, "averaged": self.averaged, "optimizer": self.optimizer}
        return parts if self.poses is None else {**parts, "poses": self.poses}

    def state(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        parts = {name: part.state_dict() for name, part in self._parts().items()}
        return {"iteration": self.iteration, "generator": self.generator.get_state(), **parts}

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state`."""
        self.iteration = state["iteration"]
        self.generator.set_state(state["generator"])
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
