"""What depths ask of a field, the true slope of all; and the errors that a fit reports on known depths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_data.posed_images import PosedImages
from regnf_fit.images.coloring import HeldOutErrors, evaluate
from regnf_fit.images.depth_supervision import DepthSupervision, depth_terms, supervise
from regnf_fit.images.preparation import PixelRays, prepare, rays_of_pixels
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes

IMAGES = scenes.images(count=4, ball_alone=True)


class Ball:
    """The ball as a field."""

    def function(self) -> Ball:
        return self

    def value(self, points: Tensor) -> Tensor:
        return torch.from_numpy(scenes.ball_distance(points.double().numpy())).float()

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        outwards = points - torch.from_numpy(scenes.BALL_CENTER).float()
        return self.value(points), outwards / outwards.norm(dim=1, keepdim=True)


def errors(images: PosedImages) -> HeldOutErrors:
    field: Any = Ball()
    return evaluate(field, rays_of_pixels(images, np.arange(images.colors[..., 0].size), None), scenes.SIZE)


def with_left_half(depth: float) -> PosedImages:
    assert IMAGES.depths is not None
    depths = IMAGES.depths.copy()
    depths[:, :, : depths.shape[2] // 2] = depth
    return replace(IMAGES, depths=depths)


def test_an_exact_field_has_no_error() -> None:
    found = errors(IMAGES)
    assert found.depth_error is not None
    assert found.depth_error < 1e-3
    assert found.eikonal_error < 1e-5


def test_what_hides_the_thing_is_no_error_of_the_field() -> None:
    """A hand before the lens: the field is right about what is behind it."""
    hidden, seen = errors(with_left_half(0.1)), errors(IMAGES)
    assert hidden.depth_error == pytest.approx(seen.depth_error, rel=0.5)
    assert hidden.depth_error_median == pytest.approx(seen.depth_error_median, rel=0.5)


def test_a_surface_where_cameras_looked_through_is_an_error() -> None:
    found = errors(with_left_half(5.0))
    assert found.depth_error == pytest.approx(0.5 * (5.0 - 1.5), rel=0.25)


DEVIATION = 0.02
SLOPES = torch.linspace(0.3, 1.5, 25)


@dataclass(frozen=True)
class Plane:
    """A field whose surface is z = 0, with slopes that are true but for those within two deviations of it."""

    before: float
    behind: float

    def value(self, points: Tensor) -> Tensor:
        z = points[:, 2]
        slope = torch.where(z > 0.0, self.before, self.behind)
        return torch.where(z.abs() < 2.0 * DEVIATION, slope * z, z)


def supervision(deviation: float, cosine: float, said: float) -> DepthSupervision:
    """50,000 rays that meet the plane z = 0, which their depths miss by so much across it. said: the noise expected."""
    generator = torch.Generator().manual_seed(3)
    count = 50_000
    direction = torch.tensor([(1.0 - cosine**2) ** 0.5, 0.0, -cosine])
    depths = 2.0 / cosine + deviation / cosine * torch.randn(count, generator=generator)
    ones, zeros = torch.ones(count), torch.zeros(count)
    rays = PixelRays(
        origins=torch.tensor([0.0, 0.0, 2.0]).expand(count, 3),
        directions=direction.expand(count, 3),
        near=zeros,
        far=9.0 * ones,
        colors=torch.zeros(count, 3),
        depths=depths,
        background=zeros > 0.0,
        cosines=cosine * ones,
        deviations=zeros,
        images=zeros.long(),
    )
    band = max(6.0 * said / cosine, 0.05)
    return DepthSupervision(
        rays=rays,
        before=band * ones,
        behind=0.5 * band * ones,
        noise=3.0 * said / cosine * ones,
        trust=ones,
        detailed=torch.zeros(0, dtype=torch.long),
        free_points=torch.zeros(0, 3),
        clearances=torch.zeros(0),
        size=1.0,
    )


def best(data: DepthSupervision, side: str) -> float:
    """The slope of least error on one side of the plane, where the other side has the true one."""
    options = ReconstructionOptions(surface_rays=50_000)
    losses = []
    for slope in SLOPES.tolist():
        plane = Plane(slope, 1.0) if side == "before" else Plane(1.0, slope)
        losses.append(float(depth_terms(plane, data, options, torch.Generator().manual_seed(4))[0]))  # type: ignore[arg-type]
    return float(SLOPES[torch.tensor(losses).argmin()])


@pytest.mark.parametrize("cosine", [1.0, 0.6])
@pytest.mark.parametrize("side", ["before", "behind"])
def test_noise_does_not_flatten_the_field(side: str, cosine: float) -> None:
    assert best(supervision(DEVIATION, cosine, DEVIATION), side) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("side", ["before", "behind"])
def test_exact_depths_ask_for_exact_distances(side: str) -> None:
    assert best(supervision(0.0, 0.8, 0.0), side) == pytest.approx(1.0, abs=0.01)


def test_noise_that_nobody_expects_flattens_it() -> None:
    """The tests above can fail."""
    assert best(supervision(DEVIATION, 1.0, 0.0), "before") < 0.8


def test_bands_follow_what_images_differ_by_along_the_ray() -> None:
    images = scenes.images(count=24, height=72, width=96)
    assert images.depths is not None
    wrong = np.random.default_rng(7).normal(scale=0.02, size=(24, 1, 1)).astype(np.float32)
    depths = np.where(images.depths > 0.0, images.depths + wrong, np.float32(0.0))
    prepared = prepare(replace(images, depths=depths), "object", np.random.default_rng(0))
    data = supervise(prepared, ReconstructionOptions(), np.random.default_rng(0))
    cosines = torch.where(data.rays.cosines > 0.0, data.rays.cosines.clamp_min(0.3), 1.0)
    deviations = torch.from_numpy(prepared.spread.at(data.rays.depths.numpy())) / cosines
    assert float(deviations.min()) > 0.005
    assert torch.allclose(data.noise, 3.0 * deviations)
    assert torch.allclose(data.before, (6.0 * deviations).maximum(data.before))
    assert torch.allclose(data.behind, (3.0 * deviations).maximum(data.behind))
