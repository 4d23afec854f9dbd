"""What noisy depths ask of a field: of all slopes, the least error has the true one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from regnf_fit.images.depth_supervision import DepthSupervision, depth_terms, supervise
from regnf_fit.images.preparation import PixelRays, prepare
from regnf_fit.options import ReconstructionOptions
from tests.fit.images import scenes

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
