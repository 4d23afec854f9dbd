"""The compiled inner steps: against the tensor algebra that runs where there is no library, and against scipy."""

from __future__ import annotations

import gc
import os
import signal
import threading
import weakref
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.errors import InvalidInputError
from regnf_core.fields.build import ScaledField, build_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import CountingField, Observation, ObservedField, SdfField
from regnf_core.fields.user_fields import UserField
from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.metrics import NearestNeighbors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.native.library import SWITCH
from regnf_core.native.steps import native_model
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.residuals import Residuals, SurfacePair, residuals
from regnf_core.robust.search.bounds import ScaleBound
from regnf_core.robust.search.distance_grid import DistanceGrid, distance_grid
from regnf_core.robust.verdict import covariance
from regnf_core.robust.working_frame import Samples, WorkingField, WorkingFrame, WorkingObservation
from regnf_core.schema.kinds import VoxelGridDescription
from tests.core.fields.native_builds import variants

NAMES = ("avx512", "avx2", "plain")


@pytest.fixture(params=NAMES)
def plainly(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Work is done by the code for one set of instructions; what is given to this is called without any."""
    found = {one.name: one for one in variants()}
    if request.param not in found:
        pytest.skip(f"this processor does not run {request.param}")
    monkeypatch.setattr(compiled, "variant", lambda: found[request.param])

    def without(work: Any, *arguments: Any) -> Any:
        with monkeypatch.context() as context:
            context.setattr(compiled, "variant", lambda: None)
            return work(*arguments)

    return without


class Blob:
    """A smooth function of any sign with its gradient, not of unit length."""

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return (3.0 * points).sin().sum(-1) / 3.0, (3.0 * points).cos()


def samples(count: int, numbers: torch.Generator, **more: Any) -> Samples:
    points = 0.5 * normalize(torch.randn(count, 3, generator=numbers), dim=-1)
    values = 0.01 * torch.randn(count, generator=numbers)
    return Samples(points, values, normalize(torch.randn(count, 3, generator=numbers), dim=-1), **more)


def poses(count: int, numbers: torch.Generator) -> Sim3:
    step = torch.cat(
        [0.8 * torch.randn(count, 3, generator=numbers), 0.2 * torch.randn(count, 4, generator=numbers)], 1
    )
    return Sim3.identity().expand(count).perturb(step.double())


def observed(numbers: torch.Generator) -> WorkingObservation:
    states = torch.randint(0, 3, (9, 7, 8), generator=numbers).to(torch.uint8)
    frame = WorkingFrame(torch.tensor([0.1, 0.0, -0.1], dtype=torch.float64), 1.3)
    return WorkingObservation(Observation(states, torch.tensor([-0.7, -0.6, -0.8], dtype=torch.float64), 0.17), frame)


def pair(partial: bool, grid: bool, seed: int) -> tuple[SurfacePair, Sim3]:
    numbers = torch.Generator().manual_seed(seed)
    seen = observed(numbers) if partial else None
    hidden = torch.rand(101, generator=numbers) < 0.4 if partial else None
    scene, obj = samples(101, numbers, unobserved=seen, hidden=hidden), samples(67, numbers)
    models = [distance_grid(samples(300, numbers), 0.1) if grid else Blob() for _ in range(2)]
    return SurfacePair(models[0], models[1], scene, obj, 0.02 if partial else 0.0), poses(5, numbers)


MINIMIZATIONS = [
    Settings(),
    Settings(widest=0.5),
    Settings(normals=False),
    Settings(keeps_scale=True),
    Settings(scale=ScaleBound(0.95, 1.05), widest=0.2),
]


def assert_bundles_alike(found: Any, expected: Any, rtol: float, atol: float) -> None:
    """All their tensors, and those of what they hold."""
    assert vars(found).keys() == vars(expected).keys()
    for name, one in vars(expected).items():
        if isinstance(one, Tensor):
            torch.testing.assert_close(vars(found)[name], one, rtol=rtol, atol=atol)
        elif isinstance(one, Bundle):
            assert_bundles_alike(vars(found)[name], one, rtol, atol)
        else:
            assert vars(found)[name] == one


def assert_alike(found: Residuals, expected: Residuals, atol: float = 2e-6) -> None:
    torch.testing.assert_close(found.values, expected.values, rtol=1e-5, atol=atol)
    torch.testing.assert_close(found.jacobian, expected.jacobian, rtol=1e-5, atol=5.0 * atol)
    torch.testing.assert_close(found.cosines, expected.cosines, rtol=1e-5, atol=5.0 * atol)
    assert found.scene_count == expected.scene_count
    assert (found.unobserved is None) == (expected.unobserved is None)
    if found.unobserved is not None:
        torch.testing.assert_close(found.unobserved, expected.unobserved)
        assert 0.1 < float(found.unobserved.double().mean()) < 0.9


@pytest.mark.parametrize("offset", [None, 0.03])
@pytest.mark.parametrize("grid", [False, True])
@pytest.mark.parametrize("partial", [False, True])
def test_residuals(partial: bool, grid: bool, offset: float | None, plainly: Any) -> None:
    surfaces, T = pair(partial, grid, seed=3)
    offsets = None if offset is None else torch.linspace(-offset, offset, len(T.scale), dtype=torch.float64)
    assert_alike(residuals(surfaces, T, offsets), plainly(residuals, surfaces, T, offsets))


@pytest.mark.parametrize("steps", [0, 1, 4])
@pytest.mark.parametrize("offset", [None, 0.0, 0.04])
@pytest.mark.parametrize("settings", MINIMIZATIONS)
@pytest.mark.parametrize("partial", [False, True])
def test_minimization(partial: bool, settings: Settings, offset: float | None, steps: int, plainly: Any) -> None:
    """Poses, costs and scores, after one step and after several: their errors grow with the steps."""
    surfaces, T = pair(partial, grid=False, seed=4)
    start = None if offset is None else torch.linspace(-0.01, 0.01, 5, dtype=torch.float64)
    settings = replace(settings, max_offset=offset or 0.0, with_history=True)
    given = surfaces, settings.scale.limited_poses(T), (0.3, 0.2, 0.1, 0.05)[:steps], settings, start
    found, expected = minimize(*given), plainly(minimize, *given)
    assert_bundles_alike(found, expected, *((1e-3, 1e-4) if steps > 1 else (2e-5, 2e-5)))
    assert (found.history is None) == (steps == 0)
    if found.history is not None:
        assert found.history.T.scale.shape == (5, steps)
        assert torch.equal(found.history.T.translation[:, -1], found.T.translation)


def voxel_grid(values: Tensor, sign: Literal[1, -1] = 1) -> SdfField:
    low, spacing = (-0.6, -0.5, -0.7), (0.1, 0.12, 0.09)
    description = VoxelGridDescription(
        kind="voxel_grid", bounds=((-0.6, -0.5, -0.7), (0.5, 0.46, 0.47)), origin=low, spacing=spacing, sign=sign
    )
    return build_field(description, {"values": values})


@pytest.mark.parametrize("sign", [1, -1])
def test_fields_with_compiled_code_through_all_that_they_are_seen_by(sign: Literal[1, -1], plainly: Any) -> None:
    """Working frame, counting, another frame, another unit, an observation: what they give together, beyond the grid
    as well, and how many points are counted."""
    numbers = torch.Generator().manual_seed(8)
    turned = Sim3.exp(torch.tensor([0.3, -0.2, 0.5, 0.05, 0.02, -0.04, 0.2], dtype=torch.float64))
    inner = voxel_grid(torch.randn(12, 9, 14, generator=numbers), sign)
    field = TransformedField(ScaledField(ObservedField(inner, None), 1.4, sign), turned)
    working = [
        WorkingField(CountingField(field), WorkingFrame(torch.tensor([0.1, -0.1, 0.2]).double(), 1.7)) for _ in range(2)
    ]
    assert native_model(working[0]) is not None
    surfaces, T = pair(partial=True, grid=False, seed=5)
    given = [replace(surfaces, scene=one, obj=one) for one in working]
    found, expected = residuals(given[0], T), plainly(residuals, given[1], T)
    assert_alike(found, expected, atol=2e-5)
    minimize(given[0], T, (0.1, 0.1))
    plainly(minimize, given[1], T, (0.1, 0.1))
    counted = [one.field.evaluations for one in working]  # type: ignore[attr-defined]
    assert counted[0] == counted[1] == 4 * 5 * (101 + 67)


def test_values_that_are_not_finite_are_refused(plainly: Any) -> None:
    values = torch.zeros(12, 9, 14)
    values[5] = float("nan")
    surfaces, T = pair(partial=False, grid=False, seed=5)
    bad = WorkingField(voxel_grid(values), WorkingFrame(torch.zeros(3).double(), 1.0))
    assert native_model(bad) is not None
    for given in (replace(surfaces, scene=bad), replace(surfaces, obj=bad)):
        for way in (lambda work, *given: work(*given), plainly):
            with pytest.raises(InvalidInputError, match="NaN or infinity"):
                way(residuals, given, T)
            with pytest.raises(InvalidInputError, match="NaN or infinity"):
                way(minimize, given, T, (0.1,))


def test_values_in_float16_and_fields_that_check_their_own_values_have_no_compiled_code() -> None:
    assert native_model(voxel_grid(torch.zeros(4, 4, 4).half())) is None
    assert native_model(UserField(voxel_grid(torch.zeros(4, 4, 4)))) is None


def test_an_error_of_a_field_or_of_a_step_ends_a_minimization(plainly: Any) -> None:
    class Unwilling:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            raise KeyboardInterrupt

    surfaces, T = pair(partial=False, grid=False, seed=7)
    with pytest.raises(KeyboardInterrupt):
        minimize(replace(surfaces, obj=Unwilling()), T, (0.1,))
    for way in (minimize, lambda *given: plainly(minimize, *given)):
        steps: list[int] = []

        def stop(steps: list[int] = steps) -> None:
            steps.append(1)
            if len(steps) == 2:
                raise TimeoutError

        with pytest.raises(TimeoutError):
            way(surfaces, T, (0.1,) * 5, Settings(), None, stop)
        assert len(steps) == 2


@pytest.mark.parametrize("grid", [False, True])
def test_an_interrupt_ends_a_minimization(grid: bool) -> None:
    """One that comes while compiled code runs, and one in a field of Python's."""

    def interrupt(number: int, frame: object) -> None:
        raise InterruptedError

    surfaces, T = pair(partial=False, grid=grid, seed=7)
    many = replace(surfaces, scene_samples=samples(4000, torch.Generator().manual_seed(1)))
    before = signal.signal(signal.SIGUSR1, interrupt)  # SIGINT may be ignored where tests run in the background
    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGUSR1))
    try:
        timer.start()
        with pytest.raises(InterruptedError):
            minimize(many, T, (0.1,) * 100_000)
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, before)


@pytest.mark.parametrize("default", [torch.float64, torch.float16])
def test_torch_s_defaults_change_nothing(default: torch.dtype, plainly: Any) -> None:
    surfaces, T = pair(partial=True, grid=True, seed=3)
    field = voxel_grid(torch.rand(6, 5, 4, generator=torch.Generator().manual_seed(2)))
    points = torch.rand(50, 3)
    expected = residuals(surfaces, T), minimize(surfaces, T, (0.1, 0.1)), field.signed_distance_and_gradient(points)
    torch.set_default_dtype(default)
    try:
        found = residuals(surfaces, T), minimize(surfaces, T, (0.1, 0.1)), field.signed_distance_and_gradient(points)
    finally:
        torch.set_default_dtype(torch.float32)
    assert_alike(found[0], expected[0])
    assert_bundles_alike(found[1], expected[1], 0.0, 0.0)
    for one, other in zip(found[2], expected[2], strict=True):
        torch.testing.assert_close(one, other)


def test_nothing_waits_for_a_collection_of_garbage() -> None:
    surfaces, T = pair(partial=False, grid=False, seed=7)
    scene = Blob()
    kept = weakref.ref(scene)
    surfaces = replace(surfaces, scene=scene)
    gc.disable()
    try:
        minimize(surfaces, T, (0.1, 0.1))
        residuals(surfaces, T)
        del scene, surfaces
        assert kept() is None
    finally:
        gc.enable()


def test_what_is_given_is_not_changed() -> None:
    surfaces, T = pair(partial=False, grid=False, seed=7)
    offset = torch.zeros(5, dtype=torch.float64)
    before = T.matrix().clone()
    found = minimize(surfaces, T, (0.1, 0.1), Settings(), offset)
    assert torch.equal(T.matrix(), before)
    assert not offset.any()
    assert found.offset is not None
    assert bool(found.offset.any())


def test_places_beyond_a_grid_and_places_that_are_not_finite(plainly: Any) -> None:
    grid = distance_grid(samples(200, torch.Generator().manual_seed(1)), 0.1)
    points = torch.cat([torch.linspace(-3.0, 3.0, 60).view(-1, 3), torch.tensor([[float("nan"), 0.0, 0.0]])])
    found, expected = grid.value_and_gradient(points), plainly(grid.value_and_gradient, points)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one[:-1], other[:-1], rtol=1e-5, atol=1e-6)
        assert bool(one[-1].isnan().any())


def test_a_place_in_a_strange_observation_is_not_seen(plainly: Any) -> None:
    """A pose that is not finite, or far off, reads nothing beyond the voxels."""
    surfaces, T = pair(partial=True, grid=False, seed=5)
    T = replace(
        T, translation=torch.tensor([[1e30] * 3, [float("nan")] * 3, [float("inf")] * 3, [-1e9] * 3, [0.0] * 3])
    )
    found = residuals(surfaces, T)
    assert found.unobserved is not None
    assert bool(found.unobserved[:4, found.scene_count :].all())


@pytest.mark.parametrize("count", [1, 4, 16])
@pytest.mark.parametrize("form", ["volume", "line", "one place", "grid"])
def test_nearest_points(form: str, count: int, plainly: Any) -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(500, 3)) * {"line": [1.0, 0.0, 0.0], "one place": 0.0}.get(form, 1.0)
    if form == "grid":
        points = np.round(points * 2.0)
    places = rng.normal(size=(900, 3)) * 2.0
    given = torch.from_numpy(points), torch.from_numpy(places), count
    found = compiled.nearest(*given)
    assert found is not None
    distance, number = (part.numpy() for part in found)
    np.testing.assert_allclose(
        distance, cKDTree(points).query(places, k=range(1, count + 1))[0], rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(points[number] - places[:, None], axis=-1), distance, rtol=1e-12)
    assert all(len(set(row)) == count for row in number.tolist())
    assert plainly(compiled.nearest, *given) is None


@pytest.mark.parametrize("count", [1, 5, 700])
@pytest.mark.parametrize("cells", [1, 5, 16])
def test_nearest_points_to_cells(cells: int, count: int, plainly: Any) -> None:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(count)).double()
    low, edge = torch.tensor([-2.0, -1.5, -3.0]).double(), torch.tensor([4.0, 3.0, 6.5]).double() / cells
    found = compiled.nearest_to_cells(points, low, edge, cells)
    assert found is not None
    axes = [low[k] + (torch.arange(cells).double() + 0.5) * edge[k] for k in range(3)]
    centers = torch.cartesian_prod(*axes)
    distance, _ = cKDTree(points.numpy()).query(centers.numpy())
    np.testing.assert_allclose(found[0], distance, rtol=1e-12)
    np.testing.assert_allclose((points[found[1]] - centers).norm(dim=-1), distance, rtol=1e-12)
    assert plainly(compiled.nearest_to_cells, points, low, edge, cells) is None
    assert compiled.nearest_to_cells(points * float("nan"), low, edge, cells) is None


def test_as_many_nearest_as_there_are_points(plainly: Any) -> None:
    points = torch.randn(9, 3, generator=torch.Generator().manual_seed(1)).double()
    found = compiled.nearest(points, points[:2], 9)
    assert found is not None
    assert [sorted(row) for row in found[1].tolist()] == [list(range(9))] * 2
    assert compiled.nearest(points * 1e160, points[:2], 9) is None, "squares that are not finite"


def test_surfaces_without_samples_have_no_score(plainly: Any) -> None:
    surfaces, T = pair(partial=False, grid=True, seed=3)
    empty = replace(surfaces, object_samples=surfaces.object_samples[:0])
    for found in (minimize(empty, T, (0.1,)), plainly(minimize, empty, T, (0.1,))):
        assert bool(found.scores.isnan().all())
    assert len(minimize(surfaces, T[:0], (0.1,)).scores) == 0


def test_what_is_not_finite_is_left_to_the_other_search(plainly: Any) -> None:
    good, bad = torch.zeros(3, 3), torch.tensor([[0.0, float("nan"), 0.0]]).expand(5, 3)
    assert compiled.nearest(bad, good, 1) is None
    assert compiled.nearest(good, bad, 1) is None
    search = NearestNeighbors(good)
    for ask in (search.query, lambda places: plainly(search.query, places)):
        with pytest.raises(ValueError, match="finite"):
            ask(bad)


def test_sums_of_kernels(plainly: Any) -> None:
    numbers = torch.Generator().manual_seed(6)
    one = samples(300, numbers)
    inliers = covariance._Inliers(one.points.double(), one.normals.double(), *(torch.empty(300) for _ in range(4)))
    weights = torch.rand(10, generator=numbers).double()
    weights[::3] = 0.0
    found, expected = covariance._summed(inliers, weights), plainly(covariance._summed, inliers, weights)
    torch.testing.assert_close(found, expected, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("shapes", [((5,), (404, 3)), ((404,), (403, 3)), ((404,), (404, 2))])
def test_a_field_that_gives_too_little_is_refused(shapes: tuple[Any, Any], plainly: Any) -> None:
    class Short:
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            return torch.zeros(shapes[0]), torch.zeros(shapes[1])

    surfaces, T = pair(partial=False, grid=False, seed=7)
    surfaces, T = replace(surfaces, obj=Short()), T[:4]  # 404 places
    for ask in (residuals, lambda *given: plainly(residuals, *given)):
        with pytest.raises(RuntimeError):
            ask(surfaces, T)


def test_a_switch_turns_all_of_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "0")
    assert compiled.steps_for(torch.zeros(1)) is None
    assert compiled.nearest(torch.zeros(2, 3), torch.zeros(2, 3), 1) is None
    assert compiled.kernel_sums(torch.zeros(2, 3), torch.zeros(2, 3), torch.ones(1), torch.ones(1)) is None


def test_derivatives_and_other_numbers_go_through_tensor_algebra(plainly: Any) -> None:
    assert compiled.steps_for(torch.zeros(1)) is not None
    assert compiled.steps_for(torch.zeros(1, requires_grad=True)) is None
    assert compiled.steps_for(torch.zeros(1, dtype=torch.float64)) is None
    grid = distance_grid(samples(50, torch.Generator().manual_seed(1)), 0.1)
    assert isinstance(grid, DistanceGrid)
    assert grid.value_and_gradient(torch.zeros(2, 3, requires_grad=True))[0].requires_grad
