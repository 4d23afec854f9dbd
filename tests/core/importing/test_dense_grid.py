"""Dense grids in .npz files: the convention, what breaks it, the reference file, a registration with two of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import SdfField
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.analytic import chair, chair_pose, room, sphere
from tests.core.importing.archives import assert_refused
from tests.core.importing.test_reference_checkpoints import assert_reproduces
from tests.core.robust.shapes import detection, placement_error, run
from tests.devdata import dev_data

LOW, HIGH, NODES = np.array([-0.9, -0.8, -0.7]), np.array([0.9, 0.8, 0.7]), np.array([19, 17, 15])
SPACING = (HIGH - LOW) / (NODES - 1)


def sampled(field: SdfField, low: Any, high: Any, nodes: Any) -> np.ndarray[Any, np.dtype[np.float32]]:
    """A field's values at the nodes of a grid."""
    axes = [torch.linspace(float(a), float(b), int(n)) for a, b, n in zip(low, high, nodes, strict=True)]
    values = field.signed_distance(torch.cartesian_prod(*axes))
    return values.reshape(*[len(axis) for axis in axes]).numpy()


BALL = sampled(sphere(0.5), LOW, HIGH, NODES)


def converted(folder: Path, overrides: dict[str, Any] | None = None, **arrays: Any) -> dict[str, Any]:
    np.savez(folder / "grid.npz", **arrays)
    return convert_file(folder / "grid.npz", folder, overrides, ImportLimits())


def test_values_that_are_no_distances_are_taken_only_on_demand(tmp_path: Path) -> None:
    arrays = {"sdf": 50.0 * BALL, "origin": LOW, "spacing": SPACING}
    assert_refused(lambda: converted(tmp_path, **arrays), "FIELD_IMPLAUSIBLE")
    assert_refused(lambda: converted(tmp_path, {"accept_implausible": False}, **arrays), "FIELD_IMPLAUSIBLE")
    report = converted(tmp_path, {"accept_implausible": True}, **arrays)
    assert [warning.partition(":")[0] for warning in report["warnings"]] == ["GRADIENT_NOT_UNIT"]
    assert_refused(lambda: converted(tmp_path, **(arrays | {"sdf": 0.05 * BALL})), "FIELD_IMPLAUSIBLE")


@pytest.mark.parametrize(
    "placement",
    [
        {"origin": LOW, "spacing": SPACING},
        {"origin": LOW.astype(np.float32), "voxel_size": np.float32(SPACING[0])},
        {"origin": LOW, "voxel_size": np.array([0.1])},
        {"bounds": np.stack((LOW, HIGH))},
    ],
)
def test_every_way_to_place_a_grid_gives_the_same_field(tmp_path: Path, placement: dict[str, Any]) -> None:
    report = converted(tmp_path, sdf=BALL, **placement)
    assert report["family"] == "dense_sdf_grid"
    assert report["warnings"] == []
    np.testing.assert_allclose(report["bounds"], [LOW, HIGH], rtol=0, atol=1e-6)
    opened = open_field(tmp_path / FIELD_NAME)
    nodes = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.8, 0.0], [-0.9, -0.8, -0.7]])
    torch.testing.assert_close(opened.signed_distance(nodes), nodes.norm(dim=-1) - 0.5, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "values", [BALL.astype(np.float64), BALL.astype(np.float16), np.asfortranarray(BALL), BALL[::-1, ::-1, ::-1]]
)
def test_element_types_and_memory_orders_are_told_apart(tmp_path: Path, values: Any) -> None:
    """The ball is symmetric, so its grid read backwards is the same grid."""
    converted(tmp_path, values=values, origin=LOW, spacing=SPACING)
    point = torch.tensor([[0.3, -0.4, 0.1]])
    torch.testing.assert_close(
        open_field(tmp_path / FIELD_NAME).signed_distance(point), point.norm(dim=-1) - 0.5, rtol=0, atol=5e-3
    )


def test_compressed_files_are_taken_and_other_arrays_left_alone_even_pickled_ones(tmp_path: Path) -> None:
    notes = np.array([{"made": "by hand"}])
    np.savez_compressed(tmp_path / "grid.npz", sdf=BALL, origin=LOW, spacing=SPACING, notes=notes)
    report = convert_file(tmp_path / "grid.npz", tmp_path, None, ImportLimits())
    assert (report["family"], report["parameters"]) == ("dense_sdf_grid", BALL.size)


def test_what_the_uploader_says_goes_before(tmp_path: Path) -> None:
    overrides = {"world_scale": 0.001, "sign": -1, "up_axis": "y", "label": "ball", "family": "dense_sdf_grid"}
    converted(tmp_path, overrides, sdf=-BALL, origin=LOW, spacing=SPACING)
    description = read_description(tmp_path / FIELD_NAME)
    assert [description[key] for key in ("sign", "up_axis", "label")] == [-1, "y", "ball"]
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(torch.tensor([[0.0, 0.0009, 0.0], [0.0, 0.0018, 0.0]]))
    torch.testing.assert_close(distance, torch.tensor([0.0004, 0.0013]), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"sdf": BALL, "spacing": SPACING}, "BOUNDS_INVALID"),
        ({"sdf": BALL, "origin": LOW, "bounds": np.stack((LOW, HIGH)), "spacing": SPACING}, "BOUNDS_INVALID"),
        ({"sdf": BALL, "origin": LOW, "spacing": -SPACING}, "BOUNDS_INVALID"),
        ({"sdf": BALL, "bounds": np.stack((HIGH, LOW))}, "BOUNDS_INVALID"),
        ({"sdf": BALL, "origin": LOW}, "TENSOR_MISSING"),
        ({"sdf": BALL, "origin": LOW[:2], "spacing": SPACING}, "TENSOR_SHAPE"),
        ({"sdf": BALL, "origin": LOW, "spacing": np.ones((3, 3))}, "TENSOR_SHAPE"),
        ({"sdf": BALL, "origin": LOW, "spacing": np.array([0.1, np.nan, 0.1])}, "TENSOR_NOT_FINITE"),
        ({"sdf": BALL, "origin": np.array(["a", "b", "c"]), "spacing": SPACING}, "TENSOR_DTYPE"),
        ({"sdf": BALL[0], "origin": LOW, "spacing": SPACING}, "TENSOR_SHAPE"),
        ({"sdf": BALL[:1], "origin": LOW, "spacing": SPACING}, "TENSOR_SHAPE"),
        ({"sdf": BALL[:0], "origin": LOW, "spacing": SPACING}, "TENSOR_SHAPE"),
        ({"sdf": BALL > 0, "origin": LOW, "spacing": SPACING}, "TENSOR_DTYPE"),
        ({"sdf": np.where(BALL > 0.5, np.nan, BALL), "origin": LOW, "spacing": SPACING}, "TENSOR_NOT_FINITE"),
        ({"sdf": np.array([{}]), "origin": LOW, "spacing": SPACING}, "NPY_OBJECT_ARRAY"),
        ({"sdf": np.abs(BALL) + 1, "origin": LOW, "spacing": SPACING}, "NO_ZERO_LEVEL"),
        ({"occupancy": BALL}, "FIELD_NOT_RECOGNIZED"),
    ],
)
def test_what_breaks_the_convention_is_refused(tmp_path: Path, arrays: dict[str, Any], reason: str) -> None:
    assert_refused(lambda: converted(tmp_path, **arrays), reason)


def test_entries_that_mean_nothing_are_refused(tmp_path: Path) -> None:
    arrays = {"sdf": BALL, "origin": LOW, "spacing": SPACING}
    assert_refused(lambda: converted(tmp_path, {"level_mask": 3}, **arrays), "INVALID_DESCRIPTION")
    assert_refused(lambda: converted(tmp_path, {"family": "neus"}, **arrays), "FAMILY_NOT_SUPPORTED")


def test_the_reference_file_is_reproduced(tmp_path: Path) -> None:
    folder = dev_data("formats", "dense_sdf_grid")
    report = convert_file(folder / "sdf_grid.npz", tmp_path, None, ImportLimits())
    assert (report["family"], report["warnings"]) == ("dense_sdf_grid", [])
    assert_reproduces(tmp_path / FIELD_NAME, folder)


def test_a_grid_of_a_chair_registers_in_a_grid_of_a_room(tmp_path: Path) -> None:
    truth = chair_pose()
    fields = []
    for name, field, reach in (("room", room(truth), 1.0), ("chair", chair(), 0.6)):
        (tmp_path / name).mkdir()
        nodes = [96, 96, 96]
        values = sampled(field, [-reach] * 3, [reach] * 3, nodes)
        converted(tmp_path / name, sdf=values, bounds=np.array([[-reach] * 3, [reach] * 3]))
        fields.append(open_field(tmp_path / name / FIELD_NAME))
    result = run(fields[0], fields[1], detection())
    assert result.verdict == "registered"
    assert placement_error(result, truth) < 0.01


@pytest.mark.parametrize("outward", [1, -1])
def test_nodes_without_weight_are_free_space_beyond_what_was_seen(tmp_path: Path, outward: int) -> None:
    weights = np.full(BALL.shape, 3.0)
    weights[:, :, :4] = 0.0
    values = np.where(weights > 0, outward * BALL, 7.0)
    report = converted(tmp_path, {"sign": outward}, sdf=values, weight=weights, origin=LOW, spacing=SPACING)
    assert any("of the nodes were observed" in why for why in report["why"])
    seen_low = LOW + np.array([0.0, 0.0, 4 * SPACING[2]])
    deep = torch.tensor(seen_low - np.array([0.0, 0.0, 3 * SPACING[2]])).float()
    corner = float(np.linalg.norm(seen_low) - 0.5)
    opened = open_field(tmp_path / FIELD_NAME)
    assert float(opened.signed_distance(deep[None])) == pytest.approx(corner + 3 * SPACING[2], abs=1e-4)
    arrays = {"sdf": BALL, "origin": LOW, "spacing": SPACING}
    assert_refused(lambda: converted(tmp_path, weights=weights[1:], **arrays), "TENSOR_SHAPE")
    assert_refused(lambda: converted(tmp_path, weights=0 * weights, **arrays), "TENSOR_SHAPE")
