"""What a detection allows: by hand, for a cube of edge 1 in a box of edge 2, scaled to a diagonal of 1."""

from __future__ import annotations

import math

import pytest
import torch

from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.options import RegistrationOptions
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.pipeline import WarmStart
from regnf_core.robust.search.bounds import PoseBound
from tests.core.robust.shapes import random_pose, reframed

CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
EDGE = 1.0 / math.sqrt(3.0)
"""Of the box, in the scene's working frame."""


def bound(tolerance: float, rotation: torch.Tensor | None = None) -> PoseBound:
    turn = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
    box = OrientedBox(torch.tensor([5.0, 6.0, 7.0]), torch.tensor([2.0, 2.0, 2.0]), turn)
    return PoseBound.of(box, CORNERS, tolerance)


def placed(edge: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sim3:
    """The pose that lays the cube with this edge, as a share of the box's, at ``center``, in shares of it too."""
    at = Sim3(
        torch.tensor([edge * EDGE], dtype=torch.float64),
        torch.eye(3, dtype=torch.float64)[None],
        torch.tensor([center], dtype=torch.float64) * EDGE,
    )
    return at.inverse()


@pytest.mark.parametrize(
    ("edge", "center", "tolerance", "admitted"),
    [
        (1.0, (0.0, 0.0, 0.0), 0.0, True),
        (1.01, (0.0, 0.0, 0.0), 0.0, False),
        (0.9, (0.04, 0.0, 0.0), 0.0, True),
        (0.9, (0.0, 0.0, 0.06), 0.0, False),
        (1.9, (0.0, 0.0, 0.0), 0.5, True),
        (2.1, (0.0, 0.0, 0.0), 0.5, False),
        (0.26, (0.0, 0.0, 0.0), 0.5, True),
        (0.24, (0.0, 0.0, 0.0), 0.5, False),
        (160.0, (0.0, 0.0, 0.0), 1.0, False),
        (1 / 160.0, (0.0, 0.0, 0.0), 1.0, False),
    ],
)
def test_extent_and_place(edge: float, center: tuple[float, float, float], tolerance: float, admitted: bool) -> None:
    assert bound(tolerance).admits(placed(edge, center)).tolist() == [admitted]


def test_the_boxs_own_axes_count() -> None:
    """A box turned by 45 degrees about z sees the cube's diagonal, sqrt 2 edges long."""
    half = math.sqrt(0.5)
    turn = torch.tensor([[half, -half, 0.0], [half, half, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    poses = Sim3.cat([placed(0.70), placed(0.71)])
    assert bound(0.0, turn).admits(poses).tolist() == [True, False]


def test_a_pose_that_fills_the_box_is_not_penalized() -> None:
    poses = Sim3.cat([placed(1.0), placed(0.9), placed(0.5), placed(2.5), placed(1.0, (0.3, 0.0, 0.0))])
    exact, tight, small, large, beside = bound(1.0).penalty(poses).tolist()
    assert exact == pytest.approx(0.0, abs=1e-12)
    assert exact < tight < beside < small < large < SEARCH.box_weight


def test_the_penalty_is_half_its_weight_where_every_face_is_one_kernel_width_off() -> None:
    pose = placed(1.0 + 2.0 * SEARCH.box_width)
    assert float(bound(1.0).penalty(pose)) == pytest.approx(SEARCH.box_weight / 2)


def test_loosened() -> None:
    assert not bound(0.1).admits(placed(1.3)).item()
    assert bound(0.1).loosened(2.0).admits(placed(1.3)).item()


@pytest.mark.parametrize(
    ("tolerance", "verdict", "reason"),
    [(0.0, "rejected", "OUTSIDE_DETECTION"), (1.0, "registered", "SURFACES_AGREE")],
)
def test_around_a_part_the_tolerance_decides(tolerance: float, verdict: str, reason: str) -> None:
    """Every edge of the box is 0.7 of the chair's. The search begins at the right pose, so it is the one judged."""
    scene, obj, box, truth = reframed(random_pose(1, 1.0), random_pose(2, 1.0))
    part = OrientedBox(box.center, 0.7 * box.size, box.rotation)
    options = RegistrationOptions.from_dict({"robust": {"box_tolerance": tolerance}})
    found = register(scene, obj, part, options, seed=0, warm_start=WarmStart(T_object_scene=truth), clouds=False)
    assert (found.verdict, found.verdict_reason) == (verdict, reason)
    assert float(found.T_object_scene.scale) == pytest.approx(float(truth.scale), rel=1e-3)


def test_a_flat_boxs_thickness_is_compared_with_more_than_itself() -> None:
    """A thing of 2 % of its length, whose field is three times as thick as its box, as coarse maps have it."""
    box = OrientedBox(torch.zeros(3), torch.tensor([1.0, 1.0, 0.02]), torch.eye(3, dtype=torch.float64))
    thick = CORNERS * torch.tensor([1.0, 1.0, 0.06])
    true = Sim3(
        torch.tensor([math.hypot(1.0, 1.0, 0.02)]).double(), torch.eye(3)[None].double(), torch.zeros(1, 3).double()
    )
    twice = Sim3(true.scale / 2.2, true.rotation, true.translation)
    assert PoseBound.of(box, thick, 0.5).admits(Sim3.cat([true, twice])).tolist() == [True, False]
