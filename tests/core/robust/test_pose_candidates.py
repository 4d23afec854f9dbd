"""Copies of pose candidates."""

from __future__ import annotations

import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from tests.core.robust.shapes import random_pose


def candidates() -> PoseCandidates:
    poses = Sim3.cat([random_pose(1, 1.0), random_pose(2, 3.0)])
    return PoseCandidates(poses, torch.tensor([0.1, 0.2]), torch.tensor([0.01, 0.02]))


def test_copies_are_about_as_far_off_as_the_spread_says() -> None:
    own = candidates()
    found = own.with_copies(400, (0.1, 0.03, 0.05), torch.Generator().manual_seed(0))
    assert len(found) == 2 * 401
    torch.testing.assert_close(found.T[:2].matrix(), own.T.matrix(), rtol=0, atol=0)
    assert found.scores.tolist() == own.scores.tolist() * 401
    for number in (0, 1):
        copies = found.T[number + 2 :: 2]
        growth = (copies.scale / own.T.scale[number]).log()
        turn = (copies.rotation @ own.T.rotation[number].mT).diagonal(dim1=-2, dim2=-1).sum(-1)
        angle = ((turn - 1.0) / 2.0).clamp(-1.0, 1.0).acos()
        assert 0.045 < float(growth.std()) < 0.055
        assert 0.09 < float((angle.square().mean() / 3.0).sqrt()) < 0.11


def test_no_copies_leave_all_as_it_is() -> None:
    own = candidates()
    found = own.with_copies(0, (0.1, 0.03, 0.05), torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.T.matrix(), own.T.matrix(), rtol=0, atol=0)
