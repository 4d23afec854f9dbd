"""Work stays on the device: nothing is read there within an iteration, nothing is copied, no devices are mixed.

The device of these tests has no numbers; that its branches give the numbers of the CPU's is tested on the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name

from regnf_core import OrientedBox, open_field
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import Observation
from regnf_core.geometry.metrics import NearestNeighbors, nearest_of_all
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.robust import working_frame
from regnf_core.robust.model import model_object
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.refine import levenberg_marquardt
from regnf_core.robust.refine.levenberg_marquardt import Settings, minimize
from regnf_core.robust.refine.loss import adaptive_width, normal_equations
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.scene import SingleView, view_scene
from regnf_core.robust.search import distance_grid
from regnf_core.robust.search.bounds import ScaleBound
from regnf_core.robust.verdict import evidence as features_module
from regnf_core.robust.verdict.evidence import SPEAKS_FOR, gather_evidence, pose_features
from regnf_core.robust.working_frame import Samples, WorkingField, WorkingFrame
from tests.core.analytic import AnalyticField, chair, chair_pose, room, sphere
from tests.core.robust.shapes import alone, detection, run
from tests.golden.cases import EXAMPLES

# A device without a GPU: torch's "meta" device, and a watch on what crosses its border. Its tensors have no numbers: to
# read one, or to copy it to the CPU, raises. torch itself does not tell of copies to the device; the watch does.


ELSEWHERE = torch.device("meta")
_MAKERS = (torch.tensor, torch.as_tensor, Tensor.new_tensor)


class Border(TorchFunctionMode):
    """Raises where an operation mixes devices; ``copies`` names what brought numbers from the CPU to the device."""

    def __init__(self) -> None:
        super().__init__()
        self.copies: list[str] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        given = [one for one in _tensors([args, kwargs or {}]) if one.ndim > 0]
        devices = {one.device for one in given}
        made = {one.device for one in _tensors(result)}
        name = resolve_name(func)
        if len(devices) > 1 and name != "torch.Tensor.to":
            raise AssertionError(f"{name} mixes {devices}")
        if ELSEWHERE in made and ELSEWHERE not in devices and (given or func in _MAKERS):
            self.copies.append(str(name))
        return result


def _tensors(values: Any) -> Iterator[Tensor]:
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, dict):
        yield from _tensors(list(values.values()))
    elif isinstance(values, list | tuple):
        for one in values:
            yield from _tensors(one)


OPTIONS = RegistrationOptions().robust
BRANCHING = (distance_grid, levenberg_marquardt, working_frame)
"""The modules that ask where a tensor is."""


@pytest.fixture(scope="module")
def neural() -> RegistrationProblem:
    """The demo's pair, two networks, with all its tensors on the other device."""
    scene, obj = (open_field(EXAMPLES / f"{name}.safetensors") for name in ("mix-room", "armchair"))
    box = OrientedBox.from_corners([-0.84, -0.59, -0.50], [-0.29, 0.02, 0.02])
    view, model = view_scene(scene, box, OPTIONS), model_object(obj, OPTIONS)
    _ = (view.distance_grid, view.normal_roughness, model.distance_grid, model.hull)
    there = (scene.to(ELSEWHERE), obj.to(ELSEWHERE))
    return make_problem(view, model, *there, OPTIONS)


def poses(count: int) -> Sim3:
    return Sim3.identity().expand(count).perturb(torch.zeros(count, 7).double()).on(ELSEWHERE)


def observed(pair: SurfacePair) -> SurfacePair:
    """The pair with a scene that was seen from one side."""
    return replace(
        pair, scene_samples=replace(pair.scene_samples, unobserved=SingleView(torch.ones(3, device=ELSEWHERE)))
    )


@pytest.fixture
def cpu_as_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU's tensors are treated as those of another device."""
    for module in BRANCHING:
        monkeypatch.setattr(module, "on_host", lambda values: False)


def test_a_problem_is_moved_whole(neural: RegistrationProblem) -> None:
    for samples in (neural.fit.scene_samples, neural.held_out.object_samples, neural.view.foreground):
        assert {one.device for one in (samples.points, samples.values, samples.normals)} == {ELSEWHERE}
    assert neural.bound.points.device == neural.model.extremal_points.device == ELSEWHERE
    assert neural.view.distance_grid.low.device == ELSEWHERE
    T = poses(3)
    points = torch.zeros(50, 3, device=ELSEWHERE)
    with Border() as border:
        assert {one.device for one in neural.bound.judged(T)} == {ELSEWHERE}
        value, gradient = neural.model.distance_grid.value_and_gradient(points)
    assert (value.shape, gradient.shape) == ((50,), (50, 3))
    assert value.device == gradient.device == ELSEWHERE
    assert border.copies == []


@pytest.mark.parametrize("seen_from_one_side", [False, True])
def test_residuals_and_normal_equations_stay_on_the_device(
    neural: RegistrationProblem, seen_from_one_side: bool
) -> None:
    pair = observed(neural.fit) if seen_from_one_side else neural.fit
    T = poses(4)
    residuals(pair, T)  # a field may keep what it copies once
    with Border() as border:
        r = residuals(pair, T, T.scale)
        H, b = normal_equations(r, adaptive_width(r, 0.01, 0.04))
    assert r.values.device == H.device == b.device == ELSEWHERE
    assert H.shape == (4, 8, 8)
    assert border.copies == []


@pytest.mark.parametrize("max_offset", [0.0, 0.04])
@pytest.mark.parametrize("on_grids", [False, True])
def test_iterations_read_and_copy_nothing(neural: RegistrationProblem, max_offset: float, on_grids: bool) -> None:
    pair = observed(neural.fit)
    if on_grids:
        pair = replace(pair, scene=neural.view.distance_grid, obj=neural.model.distance_grid)
    settings = Settings(0.04, ScaleBound(0.5, 2.0), max_offset, with_history=True)
    start = poses(6)
    residuals(pair, start)  # a field may keep what it copies once
    reported = []
    with Border() as border:
        found = minimize(pair, start, [0.03, 0.02, 0.01], settings, start.scale, lambda: reported.append(1))
    assert len(reported) == 3
    assert found.history is not None
    assert found.T.scale.device == found.scores.device == found.history.costs.device == ELSEWHERE
    assert border.copies == []


def test_evidence_and_features_stay_on_the_device(neural: RegistrationProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the samples that are unexplained: which they are is read, once for a verdict."""
    states = Observation(torch.zeros(4, 4, 4, dtype=torch.uint8), torch.zeros(3).double(), 0.1)
    scene = working_frame.WorkingObservation(states, neural.view.frame)
    held_out = replace(neural.held_out, scene_samples=replace(neural.held_out.scene_samples, unobserved=scene))
    problem = replace(neural, held_out=held_out, view=replace(neural.view, observation=scene))
    monkeypatch.setattr(features_module, "unexplained_samples", lambda pair, T, beyond: beyond)
    T = poses(5)
    pose_features(problem, T, residuals(problem.held_out, T, T.scale), T.scale)
    with Border() as border:
        r = residuals(problem.held_out, T, T.scale)
        evidence = gather_evidence(r, T.scale, OPTIONS)
        found = pose_features(problem, T, r, T.scale)
    assert list(found) == list(SPEAKS_FOR)
    assert {one.device for one in found.values()} == {evidence.numbers["score"].device} == {ELSEWHERE}
    assert set(border.copies) <= {"torch.Tensor.new_tensor"}  # two quantiles, by their numbers


def test_the_watch_sees_what_crosses() -> None:
    there, here = torch.zeros(2, 3, device=ELSEWHERE), torch.zeros(2, 3)
    with Border() as border:
        here.to(ELSEWHERE)
        torch.tensor([1.0], device=ELSEWHERE)
        with pytest.raises(AssertionError, match="mixes"):
            there @ here.T
    assert len(border.copies) == 2
    for read in (lambda: there.tolist(), lambda: bool(there.any()), lambda: there.nonzero(), lambda: there.cpu()):
        with pytest.raises((RuntimeError, NotImplementedError)):
            read()


def test_a_tree_and_all_distances_find_the_same_neighbors() -> None:
    generator = torch.Generator().manual_seed(0)
    points, queries = torch.randn(300, 3, generator=generator), torch.randn(700, 3, generator=generator)
    distance, index = NearestNeighbors(points).query_several(queries, 5)
    found, where = nearest_of_all(points, queries, 5)
    assert torch.equal(index, where)
    torch.testing.assert_close(found, distance)


@pytest.mark.usefixtures("cpu_as_elsewhere")
def test_the_other_devices_branches_give_the_same_registration(monkeypatch: pytest.MonkeyPatch) -> None:
    found = run(room(chair_pose()), chair(), detection())
    monkeypatch.undo()
    plain = alone().result
    assert found.verdict == plain.verdict == "registered"
    assert found.metrics["field_evaluations"] == plain.metrics["field_evaluations"]
    torch.testing.assert_close(found.T_object_scene.matrix(), plain.T_object_scene.matrix(), rtol=0, atol=1e-9)


@pytest.mark.usefixtures("cpu_as_elsewhere")
def test_what_is_not_finite_is_told_when_it_is_asked_for() -> None:
    field = AnalyticField(lambda points: points[:, 0] / 0.0, sphere(1.0).bounds.tolist())
    frame = WorkingFrame(torch.zeros(3).double(), 1.0)
    samples = Samples(torch.rand(9, 3), torch.zeros(9), torch.rand(9, 3))
    pair = SurfacePair(WorkingField(field, frame), WorkingField(sphere(1.0), frame), samples, samples)
    pair.require_finite()
    residuals(pair, Sim3.identity()[None])
    with pytest.raises(InvalidInputError) as raised:
        pair.require_finite()
    assert raised.value.reason == "FIELD_NOT_FINITE"
    pair.require_finite()


def test_every_module_that_asks_where_a_tensor_is_was_asked_here() -> None:
    import sys

    asking = {
        module
        for name, module in sys.modules.items()
        if name.startswith("regnf_core.") and isinstance(module, ModuleType) and hasattr(module, "on_host")
    }
    assert asking == set(BRANCHING)


def test_where_float64_is_missing_the_cpu_works() -> None:
    def on(device: str) -> torch.device:
        field = sphere(1.0)
        monkeyed = type("Elsewhere", (type(field),), {"device": property(lambda self: torch.device(device))})
        return working_frame.working_device(monkeyed(field.formula, field.bounds.tolist()))

    assert [on(device).type for device in ("cpu", "cuda", "mps")] == ["cpu", "cuda", "cpu"]
    assert working_frame.on_host(torch.zeros(1))
    assert not working_frame.on_host(Tensor(torch.zeros(1, device=ELSEWHERE)))
