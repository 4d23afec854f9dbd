"""The color of a field whose geometry is done: a hash grid and a small network, fitted to pixels at the surface.

The geometry does not change. Where rays meet it is computed once, so that an iteration is cheap.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from regnf_core.fields.color_head import Appearance, ColorHead, PositionalEncoding
from regnf_core.fields.hash_encoding import HashEncoding
from regnf_core.schema.description import TABLE, DirectionEncoding, NetworkColor, color_tensors
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_data.posed_images import PosedImages
from regnf_fit.images.preparation import PixelRays, measured_within, rays_of_pixels
from regnf_fit.network import (
    GRID_RADIUS,
    StartShape,
    TrainableField,
    arrays_of,
    layer_tensors,
    make_optimizer,
    random_layers,
    random_table,
)
from regnf_fit.options import ReconstructionOptions

# The parameters of a field that is being fitted to images: geometry, color and the opacity's sharpness.

DIRECTION_DEGREE = 4
COLOR_INPUTS = 3 + (3 + 6 * DIRECTION_DEGREE) + 3
"""Point, direction with its sines and cosines, normal; the geometry's feature follows."""
_COLOR_LAYERS = 2


class RadianceField(TrainableField):
    """A trainable field with colors.

    The color's network has the same inputs as that of neus-facto, in its order: point, direction, normal, feature.
    """

    options: ReconstructionOptions

    def __init__(self, options: ReconstructionOptions, start: StartShape, generator: torch.Generator) -> None:
        super().__init__(options, start, generator)
        self._direction_encoding = PositionalEncoding(DIRECTION_DEGREE)
        width = options.hidden_width
        feature = torch.randn(options.feature_width, width, generator=generator) * math.sqrt(1.0 / width)
        self.feature_weight = nn.Parameter(feature)
        self.feature_bias = nn.Parameter(torch.zeros(options.feature_width))
        widths = [COLOR_INPUTS + options.feature_width] + [width] * _COLOR_LAYERS + [3]
        weights, biases = random_layers(widths, generator)
        self.color_weights, self.color_biases = nn.ParameterList(weights), nn.ParameterList(biases)
        self.background = nn.Parameter(torch.zeros(3))
        """Logit of the color behind everything."""
        self.log_sharpness = nn.Parameter(torch.zeros(()))
        """Logarithm of the sharpness over the least one that the schedule allows."""

    def feature(self, hidden: Tensor) -> Tensor:
        """The feature (N, F) that the color depends on, of what the geometry's last layer is given (N, H)."""
        return torch.addmm(self.feature_bias, hidden, self.feature_weight.T)

    def color(self, points: Tensor, directions: Tensor, normals: Tensor, features: Tensor) -> Tensor:
        """Color (N, 3) in [0, 1] of points seen along unit ``directions`` (N, 3)."""
        encoded = self._direction_encoding.encode(directions)
        h = torch.cat((points, directions, encoded, normals, features), dim=-1)
        for weight, bias in zip(self.color_weights[:-1], self.color_biases[:-1], strict=True):
            h = torch.relu(torch.addmm(bias, h, weight.T))
        return torch.sigmoid(torch.addmm(self.color_biases[-1], h, self.color_weights[-1].T))


# How well a field agrees with pixels that it was not fitted to.

_STEPS = 64
_HELD_OUT_CHUNK = 4096
_SHORTEST = 0.002
"""Diagonals: the least step; a field that is not an exact distance would otherwise be approached for ever."""
_BISECTIONS = 6


@dataclass(frozen=True)
class HeldOutErrors:
    """Depth errors: field units, of rays that met a surface, where a depth was measured, not before the bounds."""

    depth_error: float | None
    depth_error_median: float | None
    eikonal_error: float


class FirstHits(NamedTuple):
    """Of R rays: depths (R,) of the first surface, 0 where none was met · normals (R, 3), not of unit length."""

    depths: Tensor
    normals: Tensor


@torch.no_grad()
def first_hits(field: RadianceField, rays: PixelRays, size: float) -> FirstHits:
    """Where rays first enter matter: sphere tracing with a least step, then bisection."""
    chunks = torch.split(torch.arange(len(rays)), _HELD_OUT_CHUNK)  # of no rays: one, empty
    parts = [_traced(field, rays.take(index), size) for index in chunks]
    return FirstHits(*(torch.cat(column) for column in zip(*parts, strict=True)))


@torch.no_grad()
def evaluate(field: RadianceField, rays: PixelRays, size: float) -> HeldOutErrors:
    """The errors at held-out rays, but for those that something before the bounds ends: they show nothing of it."""
    occluded = (rays.depths > 0.0) & (rays.depths < rays.near)
    rays = rays.take(~rays.background & ~occluded)
    hits = first_hits(field, rays, size)
    met = hits.depths > 0.0
    both = met & (rays.depths > 0.0)
    depth_error = (hits.depths - rays.depths).abs()[both]
    norms = hits.normals[met].norm(dim=1)
    return HeldOutErrors(
        depth_error=float(depth_error.mean()) if both.any() else None,
        depth_error_median=float(depth_error.median()) if both.any() else None,
        eikonal_error=float((norms - 1.0).abs().mean()) if met.any() else 1.0,
    )


def _traced(field: RadianceField, rays: PixelRays, size: float) -> FirstHits:
    function = field.function()
    speed = rays.directions.norm(dim=1)
    before, depth = rays.near.clone(), rays.near.clone()
    inside = torch.zeros_like(depth, dtype=torch.bool)
    for _ in range(_STEPS):
        active = (~inside & (depth <= rays.far)).nonzero()[:, 0]
        if len(active) == 0:
            break
        moving = rays.take(active)
        distance = function.value(moving.at(depth[active, None])[:, 0])
        inside[active] = distance < 0.0
        on = active[distance >= 0.0]
        before[on] = depth[on]
        depth[on] += distance[distance >= 0.0].clamp_min(_SHORTEST * size) / speed[on]
    hit = inside & (depth > rays.near)
    low, high = before, depth
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        matter = function.value(rays.at(middle[:, None])[:, 0]) < 0.0
        low, high = torch.where(matter, low, middle), torch.where(matter, middle, high)
    points = rays.at(high[:, None])[:, 0]
    normals = function.value_and_gradient(points)[1]
    return FirstHits(torch.where(hit, high, 0.0), normals)


_RAYS = 60_000
"""At most so many pixels are fitted to."""
_BATCH = 2048
_ITERATIONS = 600
_TABLE_RATE, _NETWORK_RATE = 1e-2, 2e-3
_DIRECTIONS = 2
"""Frequencies of the direction: highlights of a fitted color are wide."""
_SAME_SURFACE = 0.01
"""Diagonals between where a ray meets the field and the depth that was measured."""
_CHUNK = 1 << 14


class SurfaceColor(nn.Module):
    """A trainable :class:`ColorHead`. hidden: what the geometry's last layer is given · grid: of its own table."""

    def __init__(self, hidden: int, width: int, grid: HashGridConfig, generator: torch.Generator) -> None:
        super().__init__()
        direction = DirectionEncoding("frequency", _DIRECTIONS)
        self.form = NetworkColor("network", direction=direction, gradient="unit", hash=grid, grid_radius=GRID_RADIUS)
        weights, biases = random_layers([self.form.own_width + hidden, width, width, 3], generator)
        self.weights, self.biases = nn.ParameterList(weights), nn.ParameterList(biases)
        self.table = random_table(grid, generator)

    def head(self) -> ColorHead:
        """The color of the present parameters, differentiable with respect to them."""
        assert self.form.hash is not None
        return ColorHead(self.form, tuple(self.weights), tuple(self.biases), HashEncoding(self.form.hash, self.table))

    def stored(self, half_table: bool) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """The description's entry, and the tensors by their names in the file."""
        tensors = {TABLE: self.table.half() if half_table else self.table}
        return asdict(self.form), color_tensors(arrays_of(tensors | layer_tensors(self.weights, self.biases)))


def fit_color(field: RadianceField, rays: PixelRays, size: float, seed: int) -> SurfaceColor | None:
    """The color of ``field``'s surface in the pixels of ``rays``; None where no ray meets it. size: of the bounds."""
    generator = torch.Generator().manual_seed(seed)
    device = rays.origins.device
    # Rays that show one surface alone: on the edge of what is near, a pixel mixes its color with what is behind.
    plain = ~rays.background & (rays.cosines > 0.0)
    shown = (plain if bool(plain.any()) else ~rays.background).nonzero()[:, 0]
    chosen = shown[torch.randperm(len(shown), generator=generator)[:_RAYS].to(device)]
    rays = rays.take(chosen)
    hits = first_hits(field, rays, size)
    met = hits.depths > 0.0
    if rays.depths.any():  # a ray that meets another surface than the camera saw has another's color
        met &= (hits.depths - rays.depths).abs() * rays.directions.norm(dim=1) < _SAME_SURFACE * size
    if not met.any():
        return None
    rays, depths = rays.take(met), hits.depths[met]
    directions = torch.nn.functional.normalize(rays.directions, dim=1)
    seen = appearance_of(field, rays.at(depths[:, None])[:, 0])
    color = SurfaceColor(seen.hidden.shape[1], field.options.hidden_width, field.options.grid, generator).to(device)
    optimizer = make_optimizer(color.table, [*color.weights, *color.biases], _TABLE_RATE, _NETWORK_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _ITERATIONS)
    for _ in range(_ITERATIONS):
        some = torch.randint(len(rays), (_BATCH,), generator=generator).to(device)
        batch = Appearance(seen.position[some], seen.gradient[some], seen.hidden[some])
        loss = (color.head()(batch, directions[some]) - rays.colors[some]).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return color.requires_grad_(False)


@torch.no_grad()
def appearance_of(field: RadianceField, points: Tensor) -> Appearance:
    """What a color sees of the geometry at points (N, 3)."""
    function, parts = field.function(), []
    for part in torch.split(points, _CHUNK):
        _, gradient = function.value_and_gradient(part)
        parts.append((gradient, function.mlp.hidden(function.encode(part))))
    gradients, hidden = (torch.cat(column) for column in zip(*parts, strict=True))
    return Appearance(points, gradients, hidden)


# Whole images that no color is fitted to, and how much the field's pictures are like them.

_ONE_OF = 15
_MOST_IMAGES = 4
_LEAST_IMAGES = 4
"""Of fewer images all are needed."""
_PLACES = tuple((x / 3.0, y / 3.0) for x in (-1, 0, 1) for y in (-1, 0, 1))
"""In a pixel, from its middle: a camera's pixel has the mean color of what lies in it."""
_WINDOW, _SPREAD = 11, 1.5
_LUMINANCE, _CONTRAST = 0.01**2, 0.03**2


def held_out_images(count: int) -> list[int]:
    """The numbers of the images to hold out, of so many: one of 15, evenly over them, at most four."""
    if count < _LEAST_IMAGES:
        return []
    wanted = min(max(count // _ONE_OF, 1), _MOST_IMAGES)
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


@torch.no_grad()
def likeness(
    field: RadianceField, color: SurfaceColor, images: PosedImages, chosen: list[int], size: float
) -> tuple[float, float] | None:
    """Of the field's surface, colored, to the chosen images: decibels (PSNR) over all pixels that show the object, and
    their mean structural similarity, up to 1. None where they show nothing of it."""
    squared, similar, pixels = 0.0, 0.0, 0
    for number in chosen:
        shown, seen, drawn = _picture(field, color, images, number, size)
        if not shown.any():
            continue
        pixels += int(shown.sum())
        squared += float((drawn - seen)[shown].square().mean(dim=-1).sum())
        similar += float(structural_similarity(drawn, seen)[shown].sum())
    if not pixels:
        return None
    return -10.0 * math.log10(max(squared / pixels, 1e-10)), similar / pixels


def structural_similarity(one: Tensor, other: Tensor) -> Tensor:
    """(H, W) of pictures (H, W, 3) in [0, 1], in Gaussian windows of 11 pixels, mean of channels (Wang et al. 2004)."""
    offsets = torch.arange(_WINDOW, dtype=one.dtype, device=one.device) - _WINDOW // 2
    bell = torch.exp(-0.5 * (offsets / _SPREAD).square())
    kernel = (bell[:, None] * bell / bell.sum().square())[None, None]

    def mean(picture: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(picture.permute(2, 0, 1)[:, None], (_WINDOW // 2,) * 4, mode="replicate")
        return torch.nn.functional.conv2d(padded, kernel)[:, 0].permute(1, 2, 0)

    a, b = mean(one), mean(other)
    both = mean(one * other) - a * b
    spread = mean(one.square()) - a.square() + mean(other.square()) - b.square()
    alike = (2.0 * a * b + _LUMINANCE) * (2.0 * both + _CONTRAST)
    whole: Tensor = alike / ((a.square() + b.square() + _LUMINANCE) * (spread + _CONTRAST))
    return whole.mean(dim=-1)


def _picture(
    field: RadianceField, color: SurfaceColor, images: PosedImages, number: int, size: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Which pixels (H, W) show the object, the image (H, W, 3), the field's picture; black where nothing is shown."""
    device = field.table.device
    height, width = images.colors.shape[1:3]
    pixels = number * height * width + np.arange(height * width)
    rays = rays_of_pixels(images, pixels, None).to(device)
    shown = ~rays.background & (rays.far > rays.near) if images.depths is None else measured_within(rays)
    index = shown.nonzero()[:, 0]
    drawn, seen = torch.zeros(len(rays), 3, device=device), torch.zeros(len(rays), 3, device=device)
    if len(index):
        behind = field.background.sigmoid()
        if bool(rays.background.any()):  # of what is behind the object the field knows nothing
            behind = rays.colors[rays.background].mean(dim=0)
        rays = rays.take(index)
        # by what a ray's direction changes to the pixel right of its own, and to the one below it
        right, down = torch.from_numpy(images.T_world_pixel[number, :, :2].T.copy()).to(rays.directions)
        for x, y in _PLACES:
            moved = replace(rays, directions=rays.directions + x * right + y * down)
            hits = first_hits(field, moved, size)
            met = hits.depths > 0.0
            points = moved.at(torch.where(met, hits.depths, moved.far)[:, None])[:, 0]
            towards = torch.nn.functional.normalize(moved.directions, dim=1)
            drawn[index] += torch.where(met[:, None], color.head()(appearance_of(field, points), towards), behind)
        drawn /= len(_PLACES)
        seen[index] = rays.colors
    return shown.view(height, width), seen.view(height, width, 3), drawn.view(height, width, 3)
