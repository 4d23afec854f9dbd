"""Which activation a checkpoint of instant-nsr-pl has, where no settings say it: trained networks of both."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.trainer_runs.functions import GridLayout, Network, hash_features, new_table, softplus, sphere_network
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file, run
from regnf_core.importing.gate.picture import candidate_name
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.archives import assert_refused
from tests.core.importing.networks.training import in_cube, random_shape, train

LAYOUT = GridLayout(levels=4, features=2, log2_size=12, base=8, growth=1.5, smoothstep=False)
GRID: dict[str, Any] = {"levels": 4, "features_per_level": 2, "log2_table_size": 12, "base_resolution": 8}
GRID |= {"per_level_scale": 1.5, "interpolation": "linear"}
WIDTHS = [3 + LAYOUT.levels * LAYOUT.features, 64, 5]


def kaiming_network(rng: np.random.Generator) -> Network:
    """As ``sphere_init: false`` begins: uniform weights of either sign, no biases."""
    weights = [rng.uniform(-1, 1, (after, before)) * math.sqrt(6 / before) for before, after in pairwise(WIDTHS)]
    tensors = [torch.tensor(weight, dtype=torch.float32, requires_grad=True) for weight in weights]
    return Network(tensors, [torch.zeros(rows, requires_grad=True) for rows in WIDTHS[1:]], (), torch.relu)


class Trained:
    """A network after a few steps, its checkpoint, and its function in double precision."""

    def __init__(self, sphere: bool, activation: Any, seed: int, steps: int = 80) -> None:
        rng = np.random.default_rng(seed)
        self.network = sphere_network(rng, WIDTHS, 3) if sphere else kaiming_network(rng)
        self.network.activation = activation
        self.table = new_table(rng, LAYOUT)
        if steps:
            parameters: Any = [*self.network.parameters(), self.table]
            train(self._value, parameters, random_shape(rng), in_cube(1.0), seed, steps, 5e-3)
        self.network, self.table = self.network.double(), self.table.detach().double()

    def _value(self, x: torch.Tensor) -> torch.Tensor:
        features = hash_features(LAYOUT, self.table, (x + 1) / 2)
        return self.network(torch.cat((x, features), dim=1))[:, 0]

    def save(self, folder: Path) -> Path:
        state = {"encoding.encoding.params": self.table.float().reshape(-1)}
        for i, (weight, bias) in enumerate(zip(self.network.weights, self.network.biases, strict=True)):
            state |= {f"network.layers.{2 * i}.weight": weight.float(), f"network.layers.{2 * i}.bias": bias.float()}
        named = {f"model.geometry.{name}": value for name, value in state.items()}
        named["model.scene_aabb"] = torch.tensor([-1.0] * 3 + [1.0] * 3)
        torch.save({"state_dict": named, "global_step": 20_000}, folder / "upload")
        return folder / "upload"

    def assert_is(self, folder: Path, differs: bool = False) -> None:
        """The field in the folder is this network's function; or, ``differs``, wrong by more than 1e-3 of the range."""
        points = torch.rand(500, 3, generator=torch.Generator().manual_seed(4)) * 1.9 - 0.95
        expected = self._value(points.double())
        error = (open_field(folder / FIELD_NAME).signed_distance(points) - expected).abs().max() / expected.max()
        assert (error > 1e-3) if differs else (error < 1e-5)


def test_a_network_that_began_as_a_sphere_has_softplus(tmp_path: Path) -> None:
    made = Trained(True, softplus, 0)
    report = convert_file(made.save(tmp_path), tmp_path, {"hash": GRID}, ImportLimits())
    assert any("softplus" in why and "one sign" in why for why in report["why"])
    assert any(warning.startswith("ACTIVATION_ASSUMED") for warning in report["warnings"])
    made.assert_is(tmp_path)


@pytest.mark.parametrize("seed", range(2))
def test_any_other_network_is_asked_about(seed: int, tmp_path: Path) -> None:
    """Both are drawn. Read as the other, it is another field, and behaves no worse than many that are right."""
    made = Trained(False, torch.relu, seed)
    upload = made.save(tmp_path)
    refused = run(upload, tmp_path, {"hash": GRID}, ImportLimits(), ask_by_picture=seed == 0)
    assert refused["reason"] == "LAYOUT_AMBIGUOUS"
    assert [one["description"] for one in refused["candidates"]] == [{"activation": "softplus"}, {"activation": "relu"}]
    assert all(json.dumps(one["description"]) in refused["detail"] for one in refused["candidates"])
    assert all((tmp_path / candidate_name(number)).exists() == (seed == 0) for number in (1, 2))
    for activation in ("softplus", "relu"):
        said = {"hash": GRID, "activation": activation, "accept_implausible": True}
        convert_file(upload, tmp_path, said, ImportLimits())
        made.assert_is(tmp_path, differs=activation == "softplus")


@pytest.mark.parametrize(
    ("distance", "features", "told"),
    [
        *[(64, 256, True), (57, 256, True), (7, 20, True), (64, 180, True)],
        *[(52, 256, False), (64, 160, False), (64, 0, False)],
    ],
)
def test_few_signs_tell_nothing(distance: int, features: int, told: bool, tmp_path: Path) -> None:
    """How many of 64 and of 256 weights are positive: those of the distance's row, and of the four features'."""
    made = Trained(True, softplus, 1, steps=0)
    for rows, positive in ((made.network.weights[-1][:1], distance), (made.network.weights[-1][1:], features)):
        signs = torch.ones(rows.numel())
        signs[positive:] = -1.0
        rows.copy_(rows.abs() * signs.reshape(rows.shape))
    made.network.biases[-1][0] = 0.5 if distance < 32 else -0.2
    said, upload = {"hash": GRID, "accept_implausible": True}, made.save(tmp_path)
    if told:
        convert_file(upload, tmp_path, said, ImportLimits())
    else:
        assert_refused(lambda: convert_file(upload, tmp_path, said, ImportLimits()), "LAYOUT_AMBIGUOUS")
