"""Maps of voxel blocks by compiled code: against the tensor algebra, for every set of instructions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.fields.build import ScaledField
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import ObservedField
from regnf_core.fields.voxel_blocks import VoxelBlocksField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.native.steps import native_model
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.working_frame import WorkingField, WorkingFrame
from tests.core.fields.test_voxel_blocks import ORIGIN, SIZE, field
from tests.core.robust.test_compiled_steps import assert_alike, plainly, poses, samples  # noqa: F401


def random_map(
    edge: int, cells: NDArray[Any], half: bool = False, sign: int = 1, seed: int = 3, **changes: Any
) -> VoxelBlocksField:
    """Values between -1 and 1 in blocks at cells (B, 3), some of which may occur twice."""
    blocks = np.unique(cells, axis=0).astype(np.int32)
    numbers = np.random.default_rng(seed)
    blocks = numbers.permutation(blocks)
    values = numbers.uniform(-1.0, 1.0, (len(blocks), edge, edge, edge))
    made = field(values.astype(np.float16 if half else np.float32), blocks, sign=sign, **changes)
    inner = made.field if isinstance(made, ScaledField) else made
    assert isinstance(inner, VoxelBlocksField)
    return inner


def scattered(seed: int = 0) -> NDArray[np.int64]:
    """Some 250 blocks of 1,700, most with neighbors and on both sides of the origin."""
    return np.random.default_rng(seed).integers(-6, 6, (270, 3))


def spread() -> NDArray[np.int64]:
    """So far from each other that the table has an entry for many blocks."""
    return np.concatenate([scattered(), [[1 << 19, -(1 << 19), 77], [-1000, 900, 2000]]])


def places(edge: int, count: int = 3000) -> Tensor:
    """(count, 3): round the blocks, on nodes and on borders, and far away."""
    numbers = np.random.default_rng(1)
    lattice = numbers.normal(size=(count, 3)) * 5 * edge
    lattice[::5] = np.round(lattice[::5])
    lattice[1::5, 1] = np.round(lattice[1::5, 1] / edge) * edge
    lattice[-200:] *= np.geomspace(1, 1e5, 200)[:, None]
    return torch.from_numpy((ORIGIN + SIZE * lattice).astype(np.float32))


def assert_same(made: VoxelBlocksField, points: Tensor, without: Any) -> None:
    """Values and gradients, to the rounding of the largest value round each point."""
    assert made.native_model() is not None
    value, gradient = made.signed_distance_and_gradient(points)
    expected, slope = without(made.signed_distance_and_gradient, points)
    assert value.dtype == gradient.dtype == torch.float32
    scale = 2e-6 * (1.0 + expected.abs())
    assert ((value - expected).abs() <= scale).all()
    assert ((gradient - slope).abs() <= 4.0 * scale[:, None] / SIZE).all()
    assert torch.equal(made.signed_distance(points), value)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("edge", [1, 2, 3, 8, 16])
def test_random_maps(edge: int, half: bool, sign: int, plainly: Any) -> None:  # noqa: F811
    assert_same(random_map(edge, scattered(), half, sign), places(edge), plainly)


@pytest.mark.parametrize("cells", [[[-3, 1, 2]], [[0, 0, 0], [0, 0, 1]], [[-5, 0, 0], [4, 0, 0], [0, 9, -9]]])
def test_few_blocks(cells: list[list[int]], plainly: Any) -> None:  # noqa: F811
    """Fewer than are asked at a place that none has."""
    assert_same(random_map(4, np.array(cells)), places(4), plainly)


def test_blocks_far_from_each_other(plainly: Any) -> None:  # noqa: F811
    made = random_map(8, spread())
    assert made.function.index.step > 1
    there = torch.from_numpy(np.random.default_rng(2).normal(size=(300, 3)) * 8 * SIZE).float()
    at = torch.tensor([(1 << 19) + 0.5, -(1 << 19) + 0.5, 77.5]) * 8 * SIZE
    assert_same(made, torch.cat([places(8), there + at]), plainly)


def test_a_surface_in_many_blocks(plainly: Any) -> None:  # noqa: F811
    """All blocks within a shell, each found by its number: 20,000 of them."""
    cells = np.stack(np.meshgrid(*[np.arange(-40, 40)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = cells[np.abs(np.linalg.norm(cells, axis=1) - 36) < 0.65]
    made = random_map(2, shell)
    assert len(made.function.blocks) > 20_000
    index = made.function.index
    rows = torch.randperm(len(made.function.blocks))[:2000]
    points = made.function.origin + SIZE * (2 * made.function.blocks[rows] + torch.rand(2000, 3))
    assert index.find(made.function.blocks[rows])[0].equal(rows)
    assert_same(made, points, plainly)


@pytest.mark.parametrize("half", [False, True])
def test_every_number_in_float16(half: bool, plainly: Any) -> None:  # noqa: F811
    """At a node its value comes back; what is not finite is not made finite."""
    edge = 41  # one block of more nodes than there are numbers in float16
    numbers = (np.arange(edge**3) % 65536).astype(np.uint16).view(np.float16).reshape(1, edge, edge, edge)
    values = numbers if half else numbers.astype(np.float32)
    made = field(values, np.zeros((1, 3), np.int32), origin=[0.0] * 3, voxel_size=1.0)
    nodes = torch.cartesian_prod(*[torch.arange(edge)] * 3).float()
    found, expected = made.signed_distance(nodes), plainly(made.signed_distance, nodes)
    finite = expected.isfinite()
    assert 0.9 < float(finite.float().mean()) < 1.0
    assert torch.equal(found.isfinite(), finite)
    torch.testing.assert_close(found[finite], expected[finite], rtol=0, atol=0)
    inner = finite.view(edge, edge, edge)[:-1, :-1, :-1]
    there = torch.from_numpy(numbers.astype(np.float32))[0][:-1, :-1, :-1]
    torch.testing.assert_close(found.view(edge, edge, edge)[:-1, :-1, :-1][inner], there[inner], rtol=0, atol=0)


def test_values_that_are_not_finite_reach_all_that_depends_on_them(plainly: Any) -> None:  # noqa: F811
    made = random_map(4, scattered())
    made.function.values[::3, :, 2] = float("nan")
    made.function.values[1::3, 0] = float("inf")
    points = places(4)
    found, expected = made.signed_distance(points), plainly(made.signed_distance, points)
    finite = found.isfinite()
    assert 0.1 < float(finite.float().mean()) < 0.9
    assert torch.equal(finite, expected.isfinite())
    torch.testing.assert_close(found[finite], expected[finite], rtol=2e-6, atol=2e-6)


def test_places_far_away_and_such_as_are_none(plainly: Any) -> None:  # noqa: F811
    made, nan, inf = random_map(4, scattered()), float("nan"), float("inf")
    points = torch.tensor([[nan, 0, 0], [0, inf, 0], [0, 0, -inf], [3e38, 0, 0], [nan, inf, -inf]])
    for one in made.signed_distance_and_gradient(points):
        assert one.isnan().all()
    assert plainly(made.signed_distance, points).isnan().all()
    far = torch.tensor([[1e7, 0, 0], [-1e7, 1e7, -1e7], [0, -1e12, 0], [1e17, 1.0, -1e3], [-1e17, -1e17, 1e17]])
    assert_same(made, far, plainly)
    farther = torch.tensor([[1e25, 0, 0], [-1e30, 1e30, 0.0], [0, 0, 1e37]])  # than whole numbers reach
    torch.testing.assert_close(made.signed_distance(farther).double(), farther.double().norm(dim=1), rtol=1e-5, atol=0)


def test_no_points_and_points_of_other_types(plainly: Any) -> None:  # noqa: F811
    made = random_map(4, scattered())
    distance, gradient = made.signed_distance_and_gradient(torch.zeros(0, 3))
    assert distance.shape == (0,)
    assert gradient.shape == (0, 3)
    points = places(4, 500)
    expected = made.signed_distance_and_gradient(points)
    strided = torch.stack((points, points), dim=1)[:, 0].double().requires_grad_(True)
    for one, other in zip(made.signed_distance_and_gradient(strided), expected, strict=True):
        assert torch.equal(one, other)
        assert not one.requires_grad


def test_neighbors_and_threads_change_nothing(plainly: Any) -> None:  # noqa: F811
    made, points = random_map(4, scattered()), places(4, 20_000)
    together, turned = made.signed_distance_and_gradient(points), made.signed_distance_and_gradient(points.flip(0))
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        parted = made.signed_distance_and_gradient(points)
    finally:
        torch.set_num_threads(threads)
    for one, other, third in zip(together, turned, parted, strict=True):
        assert torch.equal(one, other.flip(0))
        assert torch.equal(one, third)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
def test_compiled_code_asks_a_map_itself(sign: int, half: bool, plainly: Any) -> None:  # noqa: F811
    """Through transforms, units and an observation, as residuals and in a minimization."""
    numbers = torch.Generator().manual_seed(8)
    turned = Sim3.exp(torch.tensor([0.3, -0.2, 0.5, 0.05, 0.02, -0.04, 0.2], dtype=torch.float64))
    inner = random_map(4, np.random.default_rng(5).integers(-2, 2, (20, 3)), half, sign)
    seen = TransformedField(ScaledField(ObservedField(inner, None), 1.4, sign), turned)
    working = WorkingField(seen, WorkingFrame(torch.tensor([0.1, -0.1, 0.2]).double(), 1.7))
    assert native_model(working) is not None
    pair = SurfacePair(working, working, samples(90, numbers), samples(60, numbers), 0.0)
    start = poses(4, numbers)
    assert_alike(residuals(pair, start), plainly(residuals, pair, start), atol=2e-5)
    found, expected = minimize(pair, start, (0.2,)), plainly(minimize, pair, start, (0.2,))
    torch.testing.assert_close(found.scores, expected.scores, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.T.translation, expected.T.translation, rtol=0, atol=1e-3)


def test_what_compiled_code_does_not_read_is_evaluated_by_torch(plainly: Any) -> None:  # noqa: F811
    made = random_map(4, scattered())
    assert plainly(native_model, made) is None
    assert native_model(made.to("meta")) is None
    function = made.function
    for changed in (function.values.double(), function.values.transpose(1, 3), function.values[1:]):
        other = VoxelBlocksField(type(function)(**{**vars(function), "values": changed}), made.bounds)
        assert native_model(other) is None
    moved = made.with_inverse_deviation(3.0)
    assert moved.inverse_deviation == 3.0
    assert native_model(moved) is not None


def test_slots_hold_each_block_once(plainly: Any) -> None:  # noqa: F811
    """Numbers that are looked for at the same place first lie one after the other."""
    steps = compiled.steps_for()
    assert steps is not None
    for count in (1, 2, 3, 4, 7, 8, 1000):
        numbers = torch.arange(count) * 1_000_003
        slots = compiled.block_slots(steps, numbers, torch.arange(count).flip(0))
        held = slots[slots[:, 1] >= 0]
        assert 2 * count < len(slots) <= 4 * count + 2
        assert torch.equal(held[held[:, 0].argsort()], torch.stack((numbers, torch.arange(count).flip(0)), dim=1))
