"""Quaternions: against rotations written by hand, to matrices and back, for plain numbers and for tensors."""

from __future__ import annotations

import math

import torch

from regnf_core.geometry.exponential_map import matrix_from_quaternion, quaternion_from_matrix
from regnf_core.rotations import rotation_rows


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
