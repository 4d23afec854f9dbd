"""Euler angles: against products of plain rotations, there and back, and at the wall."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from regnf_core.geometry.metrics import euler_from_rotation, rotation_from_euler
from regnf_core.geometry.sim3 import Sim3

_angle = st.floats(-3.1, 3.1)


def _about(axis: int, angle: float) -> torch.Tensor:
    tangent = torch.zeros(7, dtype=torch.float64)
    tangent[axis] = angle
    return Sim3.exp(tangent).rotation


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
