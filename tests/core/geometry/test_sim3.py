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
from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.sim3 import Sim3

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


@settings(max_examples=60)
@given(tangents())
def test_exp_is_the_matrix_exponential(tangent: Tensor) -> None:
    # torch's own matrix exponential is off by 2e-11 for a turn of 1/32 about z, scipy's is not
    expected = torch.from_numpy(expm(generator_matrix(tangent).numpy()))
    torch.testing.assert_close(Sim3.exp(tangent).matrix(), expected, rtol=1e-11, atol=1e-11)


@settings(max_examples=60)
@given(tangents())
@example(torch.tensor([math.pi - 1e-9, 0.0, 0.0, 0.3, -0.2, 0.9, 0.7], dtype=torch.float64))
def test_log_undoes_exp(tangent: Tensor) -> None:
    torch.testing.assert_close(Sim3.exp(tangent).log(), tangent, rtol=1e-7, atol=1e-7)


@settings(max_examples=40)
@given(tangents())
def test_exp_undoes_log_even_at_half_a_turn(tangent: Tensor) -> None:
    half_turn = tangent.clone()
    half_turn[:3] = tangent[:3] / tangent[:3].norm().clamp_min(1e-12) * math.pi
    T = Sim3.exp(half_turn)
    torch.testing.assert_close(Sim3.exp(T.log()).matrix(), T.matrix(), rtol=1e-9, atol=1e-9)


@settings(max_examples=25)
@given(tangents(), tangents(), tangents())
def test_group_laws(a: Tensor, b: Tensor, c: Tensor) -> None:
    A, B, C = Sim3.exp(a), Sim3.exp(b), Sim3.exp(c)
    torch.testing.assert_close((A @ B).matrix(), A.matrix() @ B.matrix(), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(((A @ B) @ C).matrix(), (A @ (B @ C)).matrix(), rtol=1e-9, atol=1e-9)
    identity = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close((A @ A.inverse()).matrix(), identity, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close((A.inverse() @ A).matrix(), identity, rtol=1e-9, atol=1e-9)


@settings(max_examples=15)
@given(tangents())
def test_dictionary_round_trip(tangent: Tensor) -> None:
    T = Sim3.exp(tangent)
    values = json.loads(json.dumps(T.to_dict()))
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
