import math

import numpy as np
import torch

from regnf_fit.images.trainer import least_sharpness, render_weights


def test_weights_of_a_ray_computed_by_hand():
    # Phi at s f = ln 3, 0, -ln 3 is 3/4, 1/2, 1/4: alpha = 1/3 and 1/2
    distances = torch.tensor([[math.log(3.0), 0.0, -math.log(3.0)]]) / 10.0
    weights, rest = render_weights(distances, 10.0)
    torch.testing.assert_close(weights, torch.tensor([[1.0 / 3.0, 2.0 / 3.0 * 0.5]]))
    torch.testing.assert_close(rest, torch.tensor([1.0 / 3.0]))


def test_weights_agree_with_the_equation_point_by_point():
    rng = np.random.default_rng(0)
    distances = rng.normal(scale=0.1, size=(20, 12))
    sharpness = 40.0
    weights, rest = render_weights(torch.from_numpy(distances), sharpness)
    for ray in range(20):
        passed = 1.0
        for i in range(11):
            phi, following = (1.0 / (1.0 + math.exp(-sharpness * f)) for f in distances[ray, i : i + 2])
            alpha = max((phi - following) / phi, 0.0)
            assert math.isclose(float(weights[ray, i]), passed * alpha, rel_tol=1e-9, abs_tol=1e-12)
            passed *= 1.0 - alpha
        assert math.isclose(float(rest[ray]), passed, rel_tol=1e-9)


def test_weights_and_what_passes_sum_to_one_deep_in_matter_too():
    distances = torch.linspace(1.0, -40.0, 64)[None]
    weights, rest = render_weights(distances, 1000.0)
    assert torch.isfinite(weights).all()
    torch.testing.assert_close(weights.sum(dim=1) + rest, torch.ones(1))


def test_a_surface_hides_what_lies_behind_it():
    depth = torch.linspace(0.0, 4.0, 400)
    distances = torch.minimum((depth - 1.0).abs(), (depth - 3.0).abs())[None] - 0.3
    weights, _ = render_weights(distances, 200.0)
    first = weights[0, depth[:-1] < 2.0]
    assert first.sum() > 0.999
    assert abs(float((weights[0] * (depth[1:] + depth[:-1]) / 2.0).sum()) - 0.7) < 0.02


def test_free_space_lets_everything_through():
    _, rest = render_weights(torch.full((1, 30), 0.5), 100.0)
    torch.testing.assert_close(rest, torch.ones(1))


def test_the_least_sharpness_rises_from_start_to_end():
    values = [least_sharpness(share, 2.0) for share in (0.0, 0.25, 0.5, 1.0)]
    assert values == sorted(values)
    assert math.isclose(values[0], 10.0)
    assert math.isclose(values[-1], 200.0)
