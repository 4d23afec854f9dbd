"""One fit: the field, what it is fitted to, and the state between two iterations."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_fit.images.camera_poses import CameraPoses, expected_errors
from regnf_fit.images.color_terms import render_rays, samples_about_depth, samples_by_weight
from regnf_fit.images.depth_supervision import DepthSupervision, supervise
from regnf_fit.images.depth_terms import depth_terms
from regnf_fit.images.map_distances import MapDistances
from regnf_fit.images.network import RadianceField
from regnf_fit.images.opacity import least_sharpness
from regnf_fit.images.options import ReconstructionOptions
from regnf_fit.images.preparation import PreparedImages
from regnf_fit.images.rays import PixelRays
from regnf_fit.network import make_optimizer

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
        self.optimizer = make_optimizer(field.table, networks, options, sharpness)
        self.poses: CameraPoses | None = None
        if options.refine_poses and prepared.has_depth:
            errors = expected_errors(prepared.spread, prepared.size)
            self.poses = CameraPoses(prepared.images, errors).to(device)
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
        """One iteration."""
        share = self.options.rate_share(self.iteration)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * share
        loss = self._loss()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self._hold_back_fine_levels()
        self.optimizer.step()
        with torch.no_grad():
            self.field.log_sharpness.clamp_(0.0, math.log(_SHARPEST))
            keep = self.options.decay(self.iteration)
            for average, parameter in zip(self.averaged.parameters(), self.field.parameters(), strict=True):
                average.lerp_(parameter, 1.0 - keep)
        self.iteration += 1
        self._losses.append(loss.detach())

    def _hold_back_fine_levels(self) -> None:
        """Coarse to fine, as Li et al. (2023, "Neuralangelo"): a level that does not learn yet stays next to zero."""
        levels = self.options.learning_levels(self.iteration)
        if self.field.table.grad is not None and levels < len(self._level_ends):
            self.field.table.grad[self._level_ends[levels - 1] :] = 0.0

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
            loss = loss + weights.poses * poses.prior()
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
        # what lies behind a masked thing has no color of its own
        loss = weights.color * error[~rays.background].sum() / len(rays)
        if self._masked:
            wanted = (~rays.background).float()
            opacity = rendered.opacity.clamp(1e-4, 1.0 - 1e-4)
            loss = loss + weights.opacity * torch.nn.functional.binary_cross_entropy(opacity, wanted)
        return loss, rays.at(rendered.depths.detach()[:, None])[:, 0]

    def state(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        return {
            "iteration": self.iteration,
            "field": self.field.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            **({} if self.poses is None else {"poses": self.poses.state_dict()}),
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from a :meth:`state`."""
        self.iteration = state["iteration"]
        self.field.load_state_dict(state["field"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        if self.poses is not None:
            self.poses.load_state_dict(state["poses"])
