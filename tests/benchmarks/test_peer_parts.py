"""What the methods share: frames of clouds, disturbed truths, nerf2nerf's residual; by hand and by differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.peers.clouds import cloud_pair, similarity
from benchmarks.peers.disturbance import disturbed, keypoints, rigid_fit
from benchmarks.peers.nerf2nerf import RigidMotion, one_way_residuals
from regnf_core.errors import InitializationError
from regnf_core.geometry.surface_samples import SurfaceSamples
from tests.core.robust.shapes import random_pose


def some_samples(points: Tensor) -> SurfaceSamples:
    return SurfaceSamples(points.float(), torch.nn.functional.normalize(points, dim=-1).float())


def test_a_normalized_pair_leads_back_by_hand() -> None:
    """Four points about (1, 0, 0) with radius 2; the object's are the same about (0, 5, 0) with radius 6."""
    cross = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    scene, obj = 2 * cross + torch.tensor([1.0, 0, 0]), 6 * cross + torch.tensor([0.0, 5, 0])
    pair = cloud_pair(some_samples(scene), some_samples(obj), normalized=True)
    assert np.allclose(pair.scene, cross.numpy())
    assert np.allclose(pair.object, cross.numpy())
    quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    T = pair.to_object_scene(quarter)
    # (3, 0, 0) is (1, 0, 0) at work; turned it is (0, 1, 0); in the object's frame (0, 11, 0).
    assert torch.allclose(T.apply(torch.tensor([[3.0, 0, 0]]).double()), torch.tensor([[0.0, 11, 0]]).double())
    assert float(T.scale) == pytest.approx(3.0)


def test_matrices_of_other_packages() -> None:
    T = random_pose(3, 2.5)
    rounded = np.asarray(T.matrix().tolist()) + 1e-7 * np.eye(4)
    assert torch.allclose(similarity(rounded).matrix(), T.matrix(), atol=1e-6)
    for bad in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([0.0, 0.0, 0.0, 1.0]), np.full((4, 4), np.nan)):
        with pytest.raises(InitializationError):
            similarity(bad)


def test_a_disturbed_truth_is_as_far_off_as_stated() -> None:
    truth, about = random_pose(1, 1.7), torch.tensor([0.3, -0.2, 0.1])
    off = disturbed(truth, about, 10.0, 0.05, seed=4)
    difference = off @ truth.inverse()
    assert float(off.scale) == pytest.approx(1.7)
    assert math.degrees(float(difference.log()[:3].norm())) == pytest.approx(10.0)
    moved = difference.apply(about.double()[None])[0] - about.double()
    assert float(moved.norm()) == pytest.approx(0.05)


def test_keypoints_are_the_truth_with_the_stated_noise() -> None:
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    truth = random_pose(2, 0.8)
    in_scene, in_object = keypoints(points, truth, 200, 0.01, seed=5)
    error = in_object - truth.apply(in_scene)
    assert len({tuple(row) for row in in_scene.tolist()}) == 200
    assert float(error.std()) == pytest.approx(0.01, rel=0.1)
    exact_scene, exact_object = keypoints(points, truth, 5, 0.0, seed=5)
    assert torch.allclose(exact_object, truth.apply(exact_scene))


def test_the_rigid_fit_finds_the_pose_and_leaves_out_the_scale() -> None:
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rigid = random_pose(7, 1.0)
    assert torch.allclose(rigid_fit(points, rigid.apply(points)).matrix(), rigid.matrix(), atol=1e-9)
    larger = rigid_fit(points, 2.0 * rigid.apply(points))
    assert float(larger.scale) == 1.0
    assert torch.allclose(larger.rotation, rigid.rotation, atol=1e-9)
    flat = points * torch.tensor([1.0, 1.0, 0.0])
    assert float(torch.linalg.det(rigid_fit(flat, rigid.apply(flat)).rotation)) == pytest.approx(1.0)


def test_the_residuals_gradient_against_differences() -> None:
    class Ball:
        """A ball off the origin in float64, so that differences can be taken."""

        def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            arm = points - torch.tensor([0.3, -0.2, 0.1], dtype=points.dtype)
            return arm.norm(dim=-1) - 0.4, arm / arm.norm(dim=-1, keepdim=True)

    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    own = torch.rand(20, generator=generator, dtype=torch.float64)
    motion = RigidMotion(random_pose(3, 1.0), torch.tensor([0.2, 0.1, -0.3]), 1.7)

    def total(numbers: Tensor) -> Tensor:
        motion.turn.data, motion.shift.data = numbers[:3].clone(), numbers[3:].clone()
        return one_way_residuals(points, own, Ball(), motion.transform()).square().sum()  # type: ignore[arg-type]

    at = 0.3 * torch.randn(6, generator=generator, dtype=torch.float64)
    total(at).backward()
    assert motion.turn.grad is not None
    assert motion.shift.grad is not None
    gradient = torch.cat([motion.turn.grad, motion.shift.grad])
    step = 1e-6
    with torch.no_grad():
        differences = [(total(at + step * e) - total(at - step * e)) / (2 * step) for e in torch.eye(6).double()]
    assert torch.allclose(gradient, torch.stack(differences), rtol=1e-6, atol=1e-7)
