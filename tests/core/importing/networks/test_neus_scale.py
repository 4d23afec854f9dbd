"""A NeuS without settings: its scale is told as far as training ended somewhere, and the rest is a warning."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.networks.shapes import random_shape
from tests.core.importing.networks.trained import Implicit, split
from tests.core.importing.networks.training import in_ball, train


def trained(folder: Path, scale: float) -> Implicit:
    """Saved as the trainer does, without its scale."""
    rng = np.random.default_rng(5)
    network = Implicit(rng, 5, 48, 5, (2,), scale)
    train(network, list(network.parameters()), random_shape(rng), in_ball(1.0), 5, 250, 2e-3)
    state = {name: value.detach().clone() for name, value in network.state_dict().items()}
    saved = split(state, [f"lin{i}" for i in range(5)])
    torch.save({"sdf_network_fine": saved, "iter_step": 300_000}, folder / "upload")
    return network


def scale_warnings(report: dict[str, list[str]]) -> list[str]:
    return [warning for warning in report["warnings"] if warning.startswith("SCALE_ASSUMED")]


@pytest.mark.parametrize(("scale", "published"), [(1.0, 1.0), (1.08, 1.0), (2.9, 3.0)])
def test_scales_that_look_alike_are_warned_of(scale: float, published: float, tmp_path: Path) -> None:
    network = trained(tmp_path, scale)
    (warning,) = scale_warnings(convert_file(tmp_path / "upload", tmp_path, None, ImportLimits()))
    assert f'"input_scale": {published}' in warning
    (low, high) = map(float, re.findall(r"([0-9.]+) to ([0-9.]+) times", warning)[0])
    assert low <= scale / published <= high
    report = convert_file(tmp_path / "upload", tmp_path, {"input_scale": scale}, ImportLimits())
    assert scale_warnings(report) == []
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    error = (open_field(tmp_path / FIELD_NAME).signed_distance(points) - network(points)).abs().max()
    assert error < 1e-5
