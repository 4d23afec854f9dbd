"""PIN-SLAM's maps: an object that is never made, its attributes, and the reference map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.importing.archives import assert_refused
from tests.devdata import dev_data


class Config:
    """What the trainer keeps of its options; the map is pickled with it."""

    def __init__(self) -> None:
        self.weighted_first = True
        self.num_nei_cells, self.search_alpha, self.query_nn_k, self.idw_index = 2, 0.5, 6, 2
        self.main_loss_type, self.sigma_sigmoid_m, self.logistic_gaussian_ratio = "bce", 0.1, 0.5
        self.layer_norm_on, self.use_gaussian_pe, self.pos_encoding_band, self.mlp_leaky_relu = False, False, 0, False


class NeuralPoints(torch.nn.Module):
    """The map's own class: the points of a floor."""

    def __init__(self) -> None:
        super().__init__()
        self.config = Config()
        self.resolution, self.buffer_size, self.after_pgo = 0.3, 1000, False
        x, y = torch.meshgrid(torch.arange(6) * 0.3, torch.arange(6) * 0.3, indexing="ij")
        self.neural_points = torch.stack((x, y, torch.zeros(6, 6)), dim=-1).view(-1, 3)
        self.point_orientations = torch.tensor([1.0, 0, 0, 0]).repeat(36, 1)
        self.geo_features = torch.nn.Parameter(torch.eye(1, 4).repeat(37, 1))
        self.buffer_pt_index = None


def floor(change: Any = None) -> dict[str, Any]:
    """A map whose distance is the height above the floor z = 0: 40 (relu(z / 2 + 5) - relu(5)) times 0.05."""
    decoder = {
        "layers.0.weight": torch.zeros(2, 7),
        "layers.0.bias": torch.zeros(2),
        "lout.weight": torch.tensor([[40.0, -40.0]]),
        "lout.bias": torch.zeros(1),
    }
    decoder["layers.0.weight"][:, 0] = 5.0  # of every point's first feature, which is 1
    decoder["layers.0.weight"][0, 6] = 0.5
    checkpoint = {"neural_points": NeuralPoints(), "sdf": decoder, "semantic": None, "color": None}
    if change is not None:
        change(checkpoint)
    return checkpoint


def converted(folder: Path, checkpoint: dict[str, Any], overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    torch.save(checkpoint, folder / "map.pth")
    return convert_file(folder / "map.pth", folder, overrides, ImportLimits())


def test_a_map_of_a_floor(tmp_path: Path) -> None:
    report = converted(tmp_path, floor())
    assert report["family"] == "pin_slam"
    assert report["warnings"] == []
    np.testing.assert_allclose(report["bounds"], [[-0.3] * 3, [1.8, 1.8, 0.3]], rtol=0, atol=1e-6)
    points = torch.tensor([[0.4, 0.7, 0.25], [1.0, 0.2, -0.1], [0.5, 0.5, 0.0]])
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(points)
    torch.testing.assert_close(distance, points[:, 2], rtol=0, atol=1e-5)
    torch.testing.assert_close(gradient[:2], torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 1), rtol=0, atol=1e-4)
    assert read_description(tmp_path / FIELD_NAME)["oriented"] is False


def test_what_the_settings_say_is_followed(tmp_path: Path) -> None:
    def change(checkpoint: dict[str, Any]) -> None:
        points = checkpoint["neural_points"]
        points.after_pgo = True
        points.config.weighted_first = False
        points.config.query_nn_k = 4
        points.config.main_loss_type = "l1"
        checkpoint["sdf"]["lout.weight"] /= 20.0

    converted(tmp_path, floor(change))
    description = read_description(tmp_path / FIELD_NAME)
    assert (description["oriented"], description["blend_first"], description["neighbors"]) == (True, False, 4)
    assert (description["reach"], description["cell_size"], description["buffer_size"]) == (2.5, 0.3, 1000)
    assert description["max_distance"] == pytest.approx(3**0.5 * 3 * 0.3)
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(torch.tensor([[0.4, 0.7, 0.2]]))
    assert float(distance) == pytest.approx(0.2, abs=1e-5)


def test_a_decoder_without_biases(tmp_path: Path) -> None:
    checkpoint = floor()
    del checkpoint["sdf"]["layers.0.bias"], checkpoint["sdf"]["lout.bias"]
    assert converted(tmp_path, checkpoint)["warnings"] == []


def set_option(name: str, value: Any) -> Any:
    return lambda checkpoint: setattr(checkpoint["neural_points"].config, name, value)


def set_attribute(name: str, value: Any) -> Any:
    return lambda checkpoint: setattr(checkpoint["neural_points"], name, value)


def replace_map(value: Any) -> Any:
    return lambda checkpoint: checkpoint.update(neural_points=value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_option("layer_norm_on", True), "FAMILY_NOT_SUPPORTED"),
        (set_option("use_gaussian_pe", True), "FAMILY_NOT_SUPPORTED"),
        (set_option("pos_encoding_band", 4), "FAMILY_NOT_SUPPORTED"),
        (set_option("idw_index", 1), "FAMILY_NOT_SUPPORTED"),
        (set_option("query_nn_k", "six"), "TENSOR_MISSING"),
        (set_option("query_nn_k", 0), "SAFE_FORMAT_INVALID"),
        (set_option("num_nei_cells", 100), "SAFE_FORMAT_INVALID"),
        (set_option("sigma_sigmoid_m", None), "TENSOR_MISSING"),
        (set_attribute("resolution", float("nan")), "TENSOR_MISSING"),
        (set_attribute("resolution", True), "TENSOR_MISSING"),
        (set_attribute("config", None), "FAMILY_NOT_SUPPORTED"),
        (set_attribute("neural_points", torch.zeros(36, 2)), "TENSOR_SHAPE"),
        (set_attribute("neural_points", torch.arange(108.0).view(36, 3) * 1e7), "FIELD_INDEX_INVALID"),
        (set_attribute("geo_features", torch.nn.Parameter(torch.zeros(36, 4))), "TENSOR_SHAPE"),
        (set_attribute("geo_features", torch.nn.Parameter(torch.zeros(37, 5))), "TENSOR_SHAPE"),
        (replace_map(Config()), "FAMILY_NOT_SUPPORTED"),
        (replace_map({"neural_points": torch.zeros(36, 3)}), "FAMILY_NOT_SUPPORTED"),
        (lambda checkpoint: checkpoint.update(sdf=None), "TENSOR_MISSING"),
        (lambda checkpoint: checkpoint["sdf"].pop("lout.weight"), "TENSOR_MISSING"),
        (lambda checkpoint: checkpoint["sdf"].pop("layers.0.weight"), "TENSOR_MISSING"),
    ],
)
def test_maps_that_are_not_understood_are_refused(tmp_path: Path, change: Any, reason: str) -> None:
    assert_refused(lambda: converted(tmp_path, floor(change)), reason)


def test_the_reference_map_is_reproduced(tmp_path: Path) -> None:
    """About one point in a hundred may lie where the nearest neighbors change."""
    folder = dev_data("formats", "pin_slam")
    (path,) = folder.rglob("pin_map.pth")
    report = convert_file(path, tmp_path, None, ImportLimits())
    assert report["family"] == "pin_slam"
    assert report["warnings"] == []
    valid = np.load(folder / "valid.npy").reshape(-1).astype(bool)
    points = torch.from_numpy(np.load(folder / "points.npy"))
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(points)
    expected = np.load(folder / "sdf.npy").reshape(-1)
    off = np.abs(distance.numpy() - expected) > 1e-5 * np.ptp(expected)
    turned = np.abs(gradient.numpy() - np.load(folder / "gradient.npy")).max(axis=1) > 1e-3
    assert not off[valid].any()
    assert not turned[valid].any()
    assert torch.isfinite(distance).all()
    assert (distance[torch.from_numpy(~valid)] > 0).all()
