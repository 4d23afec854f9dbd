"""Rotations: Euler angles and quaternions."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from regnf_core.geometry.exponential_map import matrix_from_quaternion, quaternion_from_matrix
from regnf_core.geometry.metrics import euler_from_rotation, rotation_from_euler
from regnf_core.geometry.sim3 import Sim3
from regnf_core.rotations import rotation_rows

# Euler angles: against products of plain rotations, there and back, and at the wall.

_angle = st.floats(-3.1, 3.1)


def _about(axis: int, angle: float) -> torch.Tensor:
    tangent = torch.zeros(7, dtype=torch.float64)
    tangent[axis] = angle
    return Sim3.exp(tangent).rotation


@settings(max_examples=30)
@given(_angle, st.floats(-1.55, 1.55), _angle)
def test_order_and_round_trip(roll: float, pitch: float, yaw: float) -> None:
    angles = torch.tensor([roll, pitch, yaw], dtype=torch.float64)
    R = rotation_from_euler(angles)
    torch.testing.assert_close(R, _about(2, yaw) @ _about(1, pitch) @ _about(0, roll), rtol=0, atol=1e-12)
    torch.testing.assert_close(euler_from_rotation(R), angles, rtol=0, atol=1e-9)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_at_the_wall_the_rotation_survives(pitch: float) -> None:
    R = _about(2, 0.7) @ _about(1, pitch) @ _about(0, 0.4)
    torch.testing.assert_close(rotation_from_euler(euler_from_rotation(R)), R, rtol=0, atol=1e-7)


# Quaternions: against rotations written by hand, to matrices and back, for plain numbers and for tensors.


def unit_quaternions(count: int) -> torch.Tensor:
    q = torch.randn(count, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def test_a_quarter_turn_about_each_axis() -> None:
    h = math.sqrt(0.5)
    for axis in range(3):
        q = torch.zeros(4, dtype=torch.float64)
        q[axis], q[3] = h, h
        first, second = torch.eye(3, dtype=torch.float64)[[(axis + 1) % 3, (axis + 2) % 3]]
        torch.testing.assert_close(matrix_from_quaternion(q) @ first, second)


def test_numbers_and_tensors_give_the_same_matrix_to_the_last_bit() -> None:
    quaternions = unit_quaternions(50)
    rows = [rotation_rows(*q) for q in quaternions.tolist()]
    assert torch.equal(torch.tensor(rows, dtype=torch.float64), matrix_from_quaternion(quaternions))


def test_back_from_the_matrix() -> None:
    quaternions = unit_quaternions(200)
    upper = torch.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
    matrices = matrix_from_quaternion(quaternions)
    torch.testing.assert_close(quaternion_from_matrix(matrices), upper)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3, dtype=torch.float64).expand(200, 3, 3))
