"""Every method solves what it is made for, and every one speaks of the same transform: scene to object."""

from __future__ import annotations

import importlib.util
import math
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.peers import registry
from benchmarks.peers.clouds import cloud_pair
from benchmarks.peers.disturbance import disturbed, keypoints, rigid_fit
from benchmarks.peers.interface import Peer, PeerCase, sampled
from benchmarks.peers.judging import NO_POSE, SKIPPED, WRONG, run_one
from benchmarks.peers.nerf2nerf import Nerf2nerf, RigidMotion, one_way_residuals
from benchmarks.peers.registry import PEERS, Entry
from benchmarks.robust.cases import Case
from benchmarks.symmetric_errors import mssd
from regnf_core import Sim3
from regnf_core.errors import InitializationError
from regnf_core.geometry.surface_samples import SurfaceSamples
from tests.core.analytic import chair, chair_box, chair_pose, seen_from
from tests.core.robust.shapes import random_pose

LARGER = 1.6
RIGID = ("paper", "nerf2nerf", "fgr", "ransac_icp", "kiss_matcher", "small_gicp")
SCALED = (
    "robust",
    "fgr_normalized",
    "ransac_icp_normalized",
    "ransac_icp_scaled",
    "kiss_matcher_normalized",
)


def chair_case(scale: float) -> PeerCase:
    """A chair with one armrest, alone in the air, at a known pose: neither symmetric nor its own inverse."""
    T = chair_pose(scale)
    return sampled(Case("chair", seen_from(chair(), T), chair(), chair_box(T), T), 1.1)


@pytest.fixture(scope="module")
def same_size() -> PeerCase:
    return chair_case(1.0)


@pytest.fixture(scope="module")
def other_size() -> PeerCase:
    return chair_case(LARGER)


def peer(name: str) -> Peer:
    """The method, or a visible skip where its package is missing; nerf2nerf with fewer steps."""
    entry = PEERS[name]
    if entry.module is not None and importlib.util.find_spec(entry.module) is None:
        pytest.skip(f"package {entry.package} is not installed")
    return Nerf2nerf(steps=150) if name == "nerf2nerf" else entry.make()


def share(case: PeerCase, T: Sim3 | None) -> float:
    assert T is not None
    return mssd(T, case.truth, case.object_samples.points) / case.diameter


def test_every_method_is_tested() -> None:
    """But splatreg: on this chair it finds now the pose and now its half turn, so there is nothing to hold it to."""
    assert {*RIGID, *SCALED, "splatreg", "splatreg_normalized"} == set(PEERS)


@pytest.mark.parametrize("name", RIGID)
def test_rigid_methods_register_fields_of_one_scale(name: str, same_size: PeerCase) -> None:
    result = peer(name).register(same_size, seed=1)
    assert share(same_size, result.T_object_scene) < 0.05
    assert result.seconds > 0


@pytest.mark.parametrize("name", SCALED)
def test_scaled_methods_register_fields_of_different_scale(name: str, other_size: PeerCase) -> None:
    assert share(other_size, peer(name).register(other_size, seed=1).T_object_scene) < 0.05


@pytest.mark.parametrize("name", ["fgr", "kiss_matcher", "nerf2nerf"])
def test_methods_without_scale_keep_it_at_one(name: str, other_size: PeerCase) -> None:
    run = run_one(name, lambda: peer(name), other_size, seed=0)
    assert run["category"] in (WRONG, NO_POSE)
    if run["category"] == WRONG:
        assert run["scale_error"] == pytest.approx(LARGER - 1.0, abs=1e-4)


def test_a_method_that_gives_up_has_no_pose(same_size: PeerCase) -> None:
    class GivesUp:
        name, given, uses_samples = "gives up", "", True

        def register(self, case: PeerCase, seed: int) -> None:
            raise InitializationError("nothing found")

    run = run_one("gives up", GivesUp, same_size, seed=0)
    assert run["category"] == NO_POSE
    assert run["reason"] == "NO_INITIAL_TRANSFORM"
    assert "mssd_share" not in run


def test_a_missing_package_is_said(monkeypatch: pytest.MonkeyPatch, same_size: PeerCase) -> None:
    entry = Entry(registry.PEERS["kiss_matcher"].factory, "no_such_module", "no-such-package")
    run = run_one("kiss_matcher", entry.make, same_size, seed=0)
    assert run["category"] == SKIPPED
    assert run["reason"] == "package no-such-package is not installed"
    # A package that is found but does not load ends the same way.
    for module in ("kiss_matcher", "small_gicp", "splatreg"):
        monkeypatch.setitem(sys.modules, module, None)
    for name in ("kiss_matcher", "small_gicp", "splatreg"):
        run = run_one(name, PEERS[name].factory, same_size, seed=0)
        assert run["category"] == SKIPPED
        assert run["reason"].endswith("is not installed")


# What the methods share: frames of clouds, disturbed truths, nerf2nerf's residual.


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
