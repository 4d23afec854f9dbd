"""An object's model: its symmetries against the true group, its file against what was written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.composite import TransformedField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import register
from regnf_core.robust.model import (
    MODEL_VERSION,
    SIGNATURE_LENGTH,
    ObjectModel,
    model_object,
    read_object_model,
    signature,
    write_object_model,
)
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.working_frame import Samples
from tests.core.analytic import AnalyticField, boxes, chair, chair_pose, room, table
from tests.core.robust.shapes import ROBUST, alone, can, detection, random_pose, slab_table


def square_table() -> AnalyticField:
    """A square top on a square foot: quarter turns about z."""
    return boxes([([-0.4, -0.4, 0.1], [0.4, 0.4, 0.16]), ([-0.08, -0.08, -0.3], [0.08, 0.08, 0.1])])


def brick() -> AnalyticField:
    """Three different edges: half turns about each axis."""
    return boxes([([-0.4, -0.25, -0.12], [0.4, 0.25, 0.12])])


@pytest.mark.parametrize(
    ("shape", "order", "axis"),
    [(chair, 1, None), (slab_table, 2, "z"), (table, 2, "z"), (square_table, 4, "z"), (brick, 4, None), (can, 1, "z")],
)
def test_the_symmetry_group_is_found(shape: Callable[[], AnalyticField], order: int, axis: str | None) -> None:
    found = model_object(shape()).symmetry.group()
    assert (found.order, found.continuous) == (order, shape is can)
    assert (found.axis is None) == (axis is None)
    if axis is not None and found.axis is not None:
        assert found.axis["xyz".index(axis)] == pytest.approx(1.0, abs=1e-3)


def test_the_axis_turns_with_the_object_frame() -> None:
    pose = random_pose(3, 2.0)
    found = model_object(TransformedField(slab_table(), pose.inverse())).symmetry.group()
    assert found.order == 2
    axis = torch.tensor(found.axis, dtype=torch.float64)
    expected = pose.rotation @ torch.tensor([0.0, 0.0, 1.0]).double()
    assert float((axis @ expected).abs()) == pytest.approx(1.0, abs=1e-3)


def test_a_symmetry_carries_the_surface_onto_itself() -> None:
    model = model_object(square_table())
    points = model.samples.on_surface().double()
    exact = model.symmetry.deviation <= 0.01
    assert int(exact.sum()) == 3
    for k in exact.nonzero().squeeze(-1).tolist():
        moved = model.frame.out_of(
            model.symmetry.T.scale[k] * points @ model.symmetry.T.rotation[k].T + model.symmetry.T.translation[k]
        )
        assert square_table().signed_distance(moved).abs().max() < 0.005 * model.frame.length


def test_the_signature_does_not_depend_on_the_frame_and_tells_shapes_apart() -> None:
    def of(field: object) -> torch.Tensor:
        return model_object(field).signature  # type: ignore[arg-type]

    own, moved, other = of(chair()), of(TransformedField(chair(), random_pose(5, 7.0).inverse())), of(table())
    assert own.shape == (SIGNATURE_LENGTH,)
    assert float((own - moved).square().sum()) < 0.2 * float((own - other).square().sum())


def test_the_signature_of_two_points_is_what_the_bins_say() -> None:
    from regnf_core.robust.working_frame import Samples

    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    up = torch.tensor([[0.0, 0.0, 1.0]] * 2)
    found = signature(Samples(points, torch.zeros(2), up))
    # One distance, its own root mean square: 1 / 2.5 of the range; normals at right angles to the line, parallel.
    assert found.nonzero().squeeze(-1).tolist() == [16, 40 + ((4 * 3 + 0) * 3 + 0) * 3 + 2]
    torch.testing.assert_close(found[found > 0], torch.ones(2))


def test_a_stored_model_is_as_good_as_a_new_one(tmp_path: Path) -> None:
    model = model_object(chair())
    write_object_model(tmp_path / "chair.model", model)
    stored = read_object_model(tmp_path / "chair.model")
    fresh = alone().result
    reused = register(room(chair_pose()), chair(), detection(), ROBUST, object_model=stored, clouds=False)
    torch.testing.assert_close(reused.T_object_scene.matrix(), fresh.T_object_scene.matrix(), rtol=0, atol=0)
    assert reused.metrics["field_evaluations"] < fresh.metrics["field_evaluations"]
    assert [path.name for path in tmp_path.iterdir()] == ["chair.model"]


@pytest.mark.parametrize("fault", ["not safetensors", "missing", "version", "name", "shape", "count", "nan", "length"])
def test_a_faulty_model_file_is_refused(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "chair.model"
    write_object_model(path, model_object(slab_table()))
    tensors = load_file(path)
    metadata = {"regnf_object_model": "1" if fault == "version" else MODEL_VERSION}
    if fault == "name":
        tensors["other"] = tensors.pop("center")
    if fault == "shape":
        tensors["normals"] = tensors["normals"][:, :2].contiguous()
    if fault == "count":
        tensors["values"] = tensors["values"][1:]
    if fault == "nan":
        tensors["points"][3, 1] = float("nan")
    if fault == "length":
        tensors["lengths"][0] = -1.0
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, metadata)
    if fault == "not safetensors":
        path.write_bytes(b"PK\x03\x04")
    if fault == "missing":
        path.unlink()
    with pytest.raises(FieldFormatError) as raised:
        read_object_model(path)
    assert raised.value.reason == "OBJECT_MODEL_INVALID"


# Thin walls: boards along the axes, thinner than the sampling's cells.


def boards() -> AnalyticField:
    """Two boards, 4 thousandths of the whole thick, that stand along the axes and meet."""
    return boxes([([-0.5, -0.4, 0.003], [0.5, 0.4, 0.008]), ([0.495, -0.4, 0.008], [0.5, 0.4, 0.5])])


def on_boards(model: ObjectModel) -> tuple[Tensor, Tensor]:
    """Places on the faces of the lying board, in the model's frame, and the faces' normals."""
    x, y = torch.meshgrid(torch.linspace(-0.4, 0.25, 14), torch.linspace(-0.35, 0.35, 15), indexing="ij")
    places = [torch.stack([x, y, torch.full_like(x, z)], -1).reshape(-1, 3) for z in (0.003, 0.008)]
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]).repeat_interleave(len(places[0]), 0)
    return model.frame.into(torch.cat(places)), normals


def has_a_sample(model: ObjectModel) -> float:
    """The share of those places that have a sample of their own face within two spacings."""
    places, normals = on_boards(model)
    samples = model.samples
    near = (places[:, None] - samples.on_surface()).norm(dim=-1) < 2.0 * model.spacing
    return float((near & (normals @ samples.normals.T > 0.9)).any(1).float().mean())


def test_both_faces_of_a_thin_wall_have_samples_and_each_answers_on_its_own_side() -> None:
    model = model_object(boards())
    both = model.with_both_faces
    assert has_a_sample(model) < 0.9  # what this is about: the grid's cells see one face
    assert has_a_sample(both) > 0.99
    places, normals = on_boards(both)
    for ahead in (0.01, 0.02):
        value, gradient = both.distance_grid.value_and_gradient(places + ahead * normals)
        assert float(((gradient * normals).sum(-1) > 0.9).float().mean()) > 0.95
        assert float((value - ahead).abs().median()) < 0.002


def test_a_measured_point_meets_the_face_that_it_shows_however_noisy_it_is() -> None:
    model = model_object(boards()).with_both_faces
    places, normals = on_boards(model)
    noise = (0.015 * torch.randn(len(places), generator=torch.Generator().manual_seed(0))).clamp(-0.04, 0.04)
    samples = Samples(places + noise[:, None] * normals, torch.zeros(len(places)), normals)
    field = model.field(boards())
    still = Sim3.identity()[None]
    alone = residuals(SurfacePair(field, field, samples, samples), still)
    ahead = residuals(SurfacePair(field, field, samples, samples, 0.05), still)
    n = len(places)
    assert float((alone.cosines[:, :n] < 0.0).float().mean()) > 0.2
    assert float(ahead.cosines[:, :n].min()) > 0.99
    torch.testing.assert_close(ahead.values[0, :n], noise, rtol=0.0, atol=1e-4)
    pair = SurfacePair(field, field, samples, samples, 0.05)
    steps = 1e-3 * torch.eye(7).double()
    moved = torch.cat([residuals(pair, still.perturb(step[None])).values for step in steps])
    slopes = (moved[:, :n] - ahead.values[:, :n]).T / 1e-3
    # At fixed units of the scene: without the part that the growth of the units alone makes.
    slopes[:, 6] -= ahead.values[0, :n]
    inside = (places[:, :2].abs() < 0.3).all(-1)
    torch.testing.assert_close(ahead.jacobian[0, :n][inside], slopes[inside], rtol=0.0, atol=5e-3)
