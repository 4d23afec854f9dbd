"""An object's model: its symmetries against the true group, its file against what was written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from regnf_core.errors import FieldFormatError
from regnf_core.fields.composite import TransformedField
from regnf_core.library import register
from regnf_core.robust.model import (
    MODEL_VERSION,
    SIGNATURE_LENGTH,
    model_object,
    read_object_model,
    signature,
    write_object_model,
)
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
