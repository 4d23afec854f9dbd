from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.geometry.exponential_map import rotation_exp
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.observing import NO_SPREAD, DepthSpread
from regnf_fit.images.preparation import prepare
from regnf_fit.images.trainer import CameraPoses, expected_errors
from tests.fit.images import scenes
from tests.fit.images.test_reconstruct import SMALL, surface_errors

SHIFT, TURN = 0.025, 0.015
OPTIONS = replace(SMALL, refine_poses=True)


def astray(images, seed=0):
    """The images with poses that err."""
    rng = np.random.default_rng(seed)
    poses = images.T_world_camera.copy()
    for number in range(len(images)):
        turn = rotation_exp(torch.from_numpy(TURN * rng.normal(size=3))).numpy()
        poses[number, :3, :3] = turn @ poses[number, :3, :3]
        poses[number, :3, 3] += SHIFT * rng.normal(size=3)
    return replace(images, T_world_camera=poses)


def test_corrections_move_rays_and_images_alike():
    images = replace(scenes.images(count=3), bounds=np.array([[-2.0] * 3, [2.0] * 3]))  # which all rays meet
    poses = CameraPoses(3, 0.1, 0.1)
    with torch.no_grad():
        poses.steps += torch.randn(poses.steps.shape, generator=torch.Generator().manual_seed(1))
    rays = prepare(images, "auto", np.random.default_rng(0)).training
    again = prepare(poses.corrected(images), "auto", np.random.default_rng(0)).training
    moved = poses.correct(rays)
    torch.testing.assert_close(moved.directions, again.directions, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(moved.origins, again.origins, atol=1e-5, rtol=0.0)


def test_corrections_are_zero_in_the_mean():
    poses = CameraPoses(5, 0.2, 0.1)
    with torch.no_grad():
        poses.steps += 1.0 + torch.randn(poses.steps.shape, generator=torch.Generator().manual_seed(1))
    _, shifts = poses.corrections()
    torch.testing.assert_close(shifts.mean(0), torch.zeros(3), atol=1e-6, rtol=0.0)
    assert float(shifts.detach().norm(dim=1).min()) > 0.01, "the first image is corrected as the others are"


@pytest.mark.long
def test_poses_that_err_are_corrected(tmp_path):
    true = scenes.images(count=12)
    given = astray(true)
    with_errors, corrected = tmp_path / "given.safetensors", tmp_path / "corrected.safetensors"
    reconstruct(given, FitFiles(with_errors), replace(OPTIONS, refine_poses=False), device="cpu")
    report = reconstruct(given, FitFiles(corrected), OPTIONS, device="cpu")
    before, _ = surface_errors(open_field(with_errors), scenes.distance)
    after, _ = surface_errors(open_field(corrected), scenes.distance)
    assert after < 0.7 * before
    assert report.pose_shift is not None
    assert 0.3 * SHIFT < report.pose_shift < 4.0 * SHIFT


def test_what_is_expected_of_poses():
    found = expected_errors(DepthSpread(np.array([1.0, 2.0, 4.0]), np.array([0.01, 0.02, 0.08])), 3.0)
    assert found == (0.01, 0.02)
    assert expected_errors(NO_SPREAD, 3.0)[1] == pytest.approx(0.003)
