"""Similarity transforms: the algebra, the exponential against the matrix exponential, the ways in and out."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.exponential_map import matrix_from_quaternion, quaternion_from_matrix, skew
from regnf_core.geometry.metrics import euler_from_rotation, rotation_from_euler
from regnf_core.geometry.sim3 import Sim3
from regnf_core.rotations import TOLERANCE, rotation_rows, similarity_fault

_unit = st.floats(-1.0, 1.0, allow_nan=False)
_vector = st.tuples(_unit, _unit, _unit)


@st.composite
def tangents(draw: st.DrawFn) -> Tensor:
    """Tangents with translation parts to 2, angles from 0 to just below pi (both ends often), scales e^-3 to e^3."""
    rho = 2 * torch.tensor(draw(_vector), dtype=torch.float64)
    axis = torch.tensor(draw(_vector), dtype=torch.float64)
    if axis.norm() < 1e-3:
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    angle = draw(st.one_of(st.floats(0, math.pi - 1e-6), st.sampled_from([0.0, 1e-12, 1e-6, 1e-4, math.pi - 1e-7])))
    sigma = draw(st.one_of(st.floats(-3, 3), st.sampled_from([0.0, 1e-12, -1e-6, 1e-3, -0.5, 0.5])))
    return torch.cat([angle * axis / axis.norm(), rho, torch.tensor([sigma], dtype=torch.float64)])


def generator_matrix(tangent: Tensor) -> Tensor:
    M = torch.zeros(4, 4, dtype=torch.float64)
    M[:3, :3] = skew(tangent[:3]) + tangent[6] * torch.eye(3, dtype=torch.float64)
    M[:3, 3] = tangent[3:6]
    return M


@settings(max_examples=25)
@given(tangents())
def test_exp_is_the_matrix_exponential(tangent: Tensor) -> None:
    # torch's own matrix exponential is off by 2e-11 for a turn of 1/32 about z, scipy's is not
    expected = torch.from_numpy(expm(generator_matrix(tangent).numpy()))
    torch.testing.assert_close(Sim3.exp(tangent).matrix(), expected, rtol=1e-11, atol=1e-11)


@settings(max_examples=25)
@given(tangents())
@example(torch.tensor([math.pi - 1e-9, 0.0, 0.0, 0.3, -0.2, 0.9, 0.7], dtype=torch.float64))
def test_log_undoes_exp(tangent: Tensor) -> None:
    torch.testing.assert_close(Sim3.exp(tangent).log(), tangent, rtol=1e-7, atol=1e-7)


@settings(max_examples=20)
@given(tangents())
def test_exp_undoes_log_even_at_half_a_turn(tangent: Tensor) -> None:
    half_turn = tangent.clone()
    half_turn[:3] = tangent[:3] / tangent[:3].norm().clamp_min(1e-12) * math.pi
    T = Sim3.exp(half_turn)
    torch.testing.assert_close(Sim3.exp(T.log()).matrix(), T.matrix(), rtol=1e-9, atol=1e-9)


@settings(max_examples=12)
@given(tangents(), tangents(), tangents())
def test_group_laws(a: Tensor, b: Tensor, c: Tensor) -> None:
    A, B, C = Sim3.exp(a), Sim3.exp(b), Sim3.exp(c)
    torch.testing.assert_close((A @ B).matrix(), A.matrix() @ B.matrix(), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(((A @ B) @ C).matrix(), (A @ (B @ C)).matrix(), rtol=1e-9, atol=1e-9)
    identity = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close((A @ A.inverse()).matrix(), identity, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close((A.inverse() @ A).matrix(), identity, rtol=1e-9, atol=1e-9)


@settings(max_examples=8)
@given(tangents())
def test_dictionary_round_trip(tangent: Tensor) -> None:
    T = Sim3.exp(tangent)
    values = json.loads(json.dumps(T.to_dict()))
    assert similarity_fault(values["matrix"]) is None
    assert set(values) == {"matrix", "scale", "rotation_quaternion_xyzw", "translation"}
    torch.testing.assert_close(Sim3.from_dict(values).matrix(), T.matrix(), rtol=1e-9, atol=1e-9)
    del values["matrix"]
    torch.testing.assert_close(Sim3.from_dict(values).matrix(), T.matrix(), rtol=1e-9, atol=1e-9)


def test_apply_by_hand() -> None:
    # A quarter turn about z, doubled, then moved by (1, 2, 3): (1, 0, 0) -> (0, 1, 0) -> (0, 2, 0) -> (1, 4, 3).
    h = math.sqrt(0.5)
    T = Sim3.from_quaternion(2.0, [0.0, 0.0, h, h], [1.0, 2.0, 3.0])
    points = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]], dtype=torch.float32)
    expected = torch.tensor([[1.0, 4.0, 3.0], [-1.0, 2.0, 5.0]], dtype=torch.float32)
    torch.testing.assert_close(T.apply(points), expected)
    torch.testing.assert_close(T.inverse().apply(expected), points)


def test_batches_broadcast_over_points() -> None:
    tangent = torch.randn(5, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = torch.randn(11, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    batch = Sim3.exp(tangent)
    assert batch.matrix().shape == (5, 4, 4)
    single = torch.stack([Sim3.exp(row).apply(points) for row in tangent])
    torch.testing.assert_close(batch.apply(points), single)
    torch.testing.assert_close(Sim3.exp(batch.log()).matrix(), batch.matrix(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close((batch @ batch.inverse()).matrix(), torch.eye(4).double().expand(5, 4, 4))


def test_a_float32_matrix_is_accepted_and_cleaned() -> None:
    T = Sim3.exp(torch.tensor([0.4, -0.5, 0.6, 0.1, 0.2, 0.3, 0.3], dtype=torch.float64))
    cleaned = Sim3.from_matrix(T.matrix().float())
    R = cleaned.rotation
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    torch.testing.assert_close(cleaned.matrix(), T.matrix(), rtol=0, atol=1e-6)


GOOD = Sim3.exp(torch.tensor([0.4, -0.5, 0.6, 0.1, 0.2, 0.3, 0.3], dtype=torch.float64)).matrix()
PARTS = {"scale": 1.0, "rotation_quaternion_xyzw": [0, 0, 0, 1], "translation": [0, 0, 0]}


@pytest.mark.parametrize(
    "values",
    [
        *(
            {"matrix": matrix}
            for matrix in ("abc", [[1, 2], [3]], [["a"] * 4] * 4, {"x": 1}, None, [[10**400] * 4] * 4)
        ),
        {"matrix": GOOD[:3]},
        {"matrix": GOOD * torch.tensor([1.0, 1.0, float("nan"), 1.0])},
        {"matrix": GOOD * torch.tensor([[1.0], [1.0], [1.0], [2.0]])},  # its last row
        {"matrix": GOOD * torch.tensor([1.0, 1.01, 1.0, 1.0])},  # stretched
        {"matrix": GOOD * torch.tensor([1.0, -1.0, 1.0, 1.0])},  # mirrored
        {"matrix": GOOD * torch.tensor([0.0, 0.0, 0.0, 1.0])},
        {"scale": 1.0, "translation": [0, 0, 0]},
        *(PARTS | {"scale": scale} for scale in ("large", 0.0, float("inf"))),
        *(PARTS | {"rotation_quaternion_xyzw": q} for q in ([0, 0, 0, 0], [0, 0, 1])),
    ],
)
def test_what_is_no_similarity_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError) as caught:
        Sim3.from_dict(values)
    assert caught.value.reason == "INVALID_TRANSFORM"


def test_gradients_flow_through_exp_at_zero() -> None:
    zero = torch.zeros(7, dtype=torch.float64, requires_grad=True)
    points = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    # Turning (omega x p), moving by rho and scaling (sigma p), to first order.
    jacobian = torch.autograd.functional.jacobian(lambda v: Sim3.exp(v).apply(points)[0], zero)
    expected = torch.cat([-skew(points[0].float()), torch.eye(3), points[0, :, None]], dim=1).double()
    torch.testing.assert_close(jacobian, expected, rtol=1e-9, atol=1e-9)


def test_one_order_of_the_seven_numbers() -> None:
    """Rotation, translation, log scale: in exp, log and perturb alike, as the public covariance has them."""
    step = torch.tensor([0.3, -0.1, 0.2, 1.0, 2.0, 3.0, 0.5], dtype=torch.float64)
    identity = Sim3.identity()
    assert torch.equal(identity.perturb(step).translation, step[3:6])
    assert torch.equal(identity.perturb(step).scale, step[6].exp())
    torch.testing.assert_close(identity.perturb(step).log()[:3], step[:3])
    torch.testing.assert_close(Sim3.exp(step).log(), step)
    torch.testing.assert_close(Sim3.exp(step).rotation, identity.perturb(step).rotation)
    torch.testing.assert_close(Sim3.exp(step).scale, identity.perturb(step).scale)


@pytest.mark.parametrize("k", range(7))
def test_perturbing_the_identity_is_exp_to_first_order(k: int) -> None:
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    direction = torch.zeros(7, dtype=torch.float64)
    direction[k] = 1.0

    def slope(move: Callable[[Tensor], Sim3]) -> Tensor:
        h = 1e-5
        return (move(h * direction).apply(points) - move(-h * direction).apply(points)) / (2 * h)

    by_perturbing = slope(Sim3.identity().perturb)
    torch.testing.assert_close(by_perturbing, slope(Sim3.exp), rtol=1e-8, atol=1e-8)
    assert by_perturbing.abs().amax() > 0.5
    mixed = torch.randn(7, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
    for size in (1e-2, 1e-3, 1e-4):  # the difference is of second order
        apart = (Sim3.identity().perturb(size * mixed).matrix() - Sim3.exp(size * mixed).matrix()).abs().amax()
        assert apart < 20.0 * size**2


def test_perturb_pivots_on_the_translation() -> None:
    T = Sim3.from_matrix(GOOD)
    step = torch.tensor([0.3, -0.1, 0.2, 1.0, 2.0, 3.0, 0.5], dtype=torch.float64)
    moved = T.perturb(step)
    torch.testing.assert_close(moved.translation, T.translation + step[3:6])
    torch.testing.assert_close(moved.rotation, Sim3.identity().perturb(step).rotation @ T.rotation)
    torch.testing.assert_close(moved.scale, T.scale * step[6].exp())


def some_batch(count: int) -> Sim3:
    return Sim3.exp(torch.randn(count, 7, generator=torch.Generator().manual_seed(count), dtype=torch.float64))


def test_batches_are_indexed_like_tensors() -> None:
    T = some_batch(5)
    M = T.matrix()
    assert len(T) == 5
    assert T[2].scale.shape == ()
    for index in (2, slice(1, 4), torch.tensor([4, 0, 0]), torch.tensor([True, False, True, False, False])):
        assert torch.equal(T[index].matrix(), M[index])
    assert torch.equal(T[2][None].matrix(), M[2:3])
    assert [one.matrix().shape for one in T] == [(4, 4)] * 5
    assert torch.equal(T[3].expand(4).matrix(), M[3].expand(4, 4, 4))
    with pytest.raises(TypeError):
        iter(T[0])


def test_batches_are_joined_and_chosen_from() -> None:
    T, other = some_batch(3), some_batch(4)
    joined = Sim3.cat([T, other[1], other[:0]])
    assert torch.equal(joined.matrix(), torch.cat([T.matrix(), other.matrix()[1:2]]))
    assert Sim3.cat([]).matrix().shape == (0, 4, 4)
    mask = torch.tensor([True, False, True])
    chosen = Sim3.where(mask, T, other[:3])
    assert torch.equal(chosen.matrix(), torch.where(mask[:, None, None], T.matrix(), other.matrix()[:3]))


# The torch-free check of a similarity: what it refuses, and that the engine takes whatever it lets through.


NAN, INF = float("nan"), float("inf")


def rows(**changes: Any) -> list[list[Any]]:
    """A turn of 90 degrees about z at scale 2, with entries changed: m12=... is row 1, column 2."""
    made: list[list[Any]] = [[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]
    for name, value in changes.items():
        made[int(name[1])][int(name[2])] = value
    return made


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (rows(m00=NAN), "finite"),
        (rows(m03=INF), "finite"),
        (rows(m03=10**400), "finite"),
        (rows(m22=-2), "is a reflection"),
        (rows(m22=2.01), "different lengths"),
        (rows(m02=0.01), "sheared"),
        (rows(m33=2), "last row"),
        (rows(m30=1e-3), "last row"),
        ([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3], [0, 0, 0, 1]], "scale vanishes"),
        (rows(m00="0"), "four rows"),
        (rows(m00=True), "four rows"),
        (rows(m00=None), "four rows"),
        (rows()[:3], "four rows"),
        ([row[:3] for row in rows()], "four rows"),
        ("abcd", "four rows"),
        (["abcd"] * 4, "four rows"),
        ({"matrix": rows()}, "four rows"),
        (7, "four rows"),
    ],
)
def test_what_is_no_similarity(value: Any, said: str) -> None:
    fault = similarity_fault(value)
    assert fault is not None
    assert said in fault


def test_the_engine_takes_whatever_passes() -> None:
    generator = torch.Generator().manual_seed(0)
    passed = refused = 0
    for _ in range(80):
        T = Sim3.exp(torch.randn(7, generator=generator, dtype=torch.float64))
        matrix = T.matrix()
        noise = torch.randn(3, 3, generator=generator, dtype=torch.float64)
        matrix[:3, :3] += 0.4 * TOLERANCE * T.scale * torch.rand((), generator=generator, dtype=torch.float64) * noise
        if similarity_fault(matrix.tolist()) is None:
            passed += 1
            Sim3.from_matrix(matrix)
        else:
            refused += 1
    assert min(passed, refused) > 10  # the line runs through the cases


# Euler angles: against products of plain rotations, there and back, and at the wall.

_angle = st.floats(-3.1, 3.1)


def _about(axis: int, angle: float) -> torch.Tensor:
    tangent = torch.zeros(7, dtype=torch.float64)
    tangent[axis] = angle
    return Sim3.exp(tangent).rotation


@settings(max_examples=15)
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
