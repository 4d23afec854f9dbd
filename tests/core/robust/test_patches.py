"""What patches of the surface show: by hand, against a slow count, and for noise beside errors of shape."""

from __future__ import annotations

import pytest
import torch

from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.verdict.patches import disagreement

CENTERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], dtype=torch.float64)


def grid(count: int) -> torch.Tensor:
    """(3 * count, 3): so many points at each of the centers, a little beside it."""
    beside = torch.tensor([0.1, 0.2, 0.0], dtype=torch.float64)
    return CENTERS.repeat_interleave(count, 0) + beside


def test_by_hand() -> None:
    """Three patches of four samples. The first is .01 off, the second .01 off to either side, the third agrees; of the
    third three samples of four are free."""
    values = torch.tensor([[0.01] * 4 + [0.01, -0.01] * 2 + [0.0] * 4], dtype=torch.float64)
    compared = torch.ones(1, 12, dtype=torch.bool)
    free = torch.zeros(1, 12, dtype=torch.bool)
    free[0, 8:11] = True
    found = disagreement(CENTERS, grid(4), values, compared, free)
    between, square = (4 * 0.01) ** 2 / (4 + 1), 8 * 0.01**2
    assert float(found["coherence"]) == pytest.approx(between / (square + 12 * 0.002**2))
    assert float(found["worst_patch_free"]) == pytest.approx(3 / (4 + 1))


def test_what_is_not_compared_does_not_count() -> None:
    values = torch.full((1, 12), 0.03, dtype=torch.float64)
    none = torch.zeros(1, 12, dtype=torch.bool)
    found = disagreement(CENTERS, grid(4), values, none, none)
    assert float(found["coherence"]) == 0.0
    assert float(found["worst_patch_free"]) == 0.0


def test_noise_is_not_coherent_and_an_error_of_shape_is() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(1200, 3, generator=generator, dtype=torch.float64)
    points /= points.norm(dim=1, keepdim=True)
    centers = points[:64]
    noise = 0.01 * torch.randn(1, 1200, generator=generator, dtype=torch.float64)
    longer = 0.014 * points[None, :, 2]  # an ellipsoid in a sphere's place: of the same root mean square
    every, none = torch.ones(1, 1200, dtype=torch.bool), torch.zeros(1, 1200, dtype=torch.bool)
    of_noise, of_shape = (disagreement(centers, points, one, every, none)["coherence"] for one in (noise, longer))
    assert float(of_noise) < 0.1
    assert float(of_shape) > 0.75


@pytest.mark.parametrize("seed", [0, 1])
def test_against_a_slow_count(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    centers, points = torch.randn(8, 3, generator=generator), torch.randn(150, 3, generator=generator)
    values = 0.02 * torch.randn(3, 150, generator=generator)
    compared, free = (torch.rand(3, 150, generator=generator) < share for share in (0.7, 0.2))
    found = disagreement(centers, points, values, compared, free)
    owner = [min(range(8), key=lambda k: float((point - centers[k]).norm())) for point in points]
    for pose in range(3):
        between, shares = 0.0, []
        for patch in range(8):
            members = [number for number in range(150) if owner[number] == patch]
            counted = [float(values[pose, number]) for number in members if compared[pose, number]]
            between += sum(counted) ** 2 / (len(counted) + EVIDENCE.prior_samples)
            standing = sum(bool(free[pose, number]) for number in members)
            shares.append(standing / (len(members) + EVIDENCE.prior_samples))
        square = sum(float(values[pose, number]) ** 2 for number in range(150) if compared[pose, number])
        floor = int(compared[pose].sum()) * EVIDENCE.min_core**2
        assert float(found["coherence"][pose]) == pytest.approx(between / (square + floor), rel=1e-4)
        assert float(found["worst_patch_free"][pose]) == pytest.approx(max(shares))
