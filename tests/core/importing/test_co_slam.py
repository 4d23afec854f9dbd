"""Co-SLAM: a run by a slow writer of its own, with its settings; what is asked without, and what contradicts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.trainers.co_slam import write_co_slam
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.translating import facts, translated


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> WrittenRun:
    return write_co_slam(tmp_path_factory.mktemp("run"), np.random.default_rng(2), 15)


def settings_of(run: WrittenRun) -> dict[str, Any]:
    return dict(json.loads(next(run.folder.rglob("config.json")).read_text()))


def imported(
    run: WrittenRun, out: Path, said: dict[str, Any] | None = None, settings: dict[str, Any] | None = None
) -> dict[str, Any]:
    beside = Companions()
    if settings is not None:
        (out / "config.json").write_text(json.dumps(settings))
        beside = Companions(settings=("config.json", out / "config.json"))
    return convert_file(run.checkpoint, out, said, ImportLimits(), beside=beside)


def assert_exact(run: WrittenRun, out: Path) -> None:
    points = torch.tensor(np.random.default_rng(0).uniform(-run.reach, run.reach, (300, 3))).float()
    expected, slopes = run.reference(points)
    values, gradients = open_field(out / FIELD_NAME).signed_distance_and_gradient(points)
    assert float((values.double() - expected).abs().max()) < 1e-5 * float(expected.max() - expected.min())
    assert float((gradients.double() - slopes).norm(dim=1).quantile(0.99)) < 1e-3


def test_with_its_settings(run: WrittenRun, tmp_path: Path) -> None:
    report = imported(run, tmp_path, settings=settings_of(run))
    assert (report["family"], report["kind"]) == ("co_slam", "grid_network")
    assert_exact(run, tmp_path)


def test_a_color_is_told_to_be_left_out(run: WrittenRun, tmp_path: Path) -> None:
    checkpoint = torch.load(run.checkpoint, weights_only=False)
    checkpoint["model"]["decoder.color_net.model.0.weight"] = torch.ones(3, 8)
    torch.save(checkpoint, tmp_path / "colored.pt")
    colored = replace(run, checkpoint=tmp_path / "colored.pt")
    words = [warning.partition(":")[0] for warning in imported(colored, tmp_path, None, settings_of(run))["warnings"]]
    assert "COLOR_LEFT_OUT" in words


def test_without_settings_the_message_says_what_is_missing(run: WrittenRun, tmp_path: Path) -> None:
    assert_refused(lambda: imported(run, tmp_path), "LAYOUT_AMBIGUOUS")
    values = settings_of(run)
    del values["training"]["trunc"]  # then nothing knows the file
    values["mapping"]["bound"] = None
    assert_refused(lambda: imported(run, tmp_path, settings=values), "SETTINGS_NOT_RECOGNIZED")


def test_the_description_may_say_it(run: WrittenRun, tmp_path: Path) -> None:
    used = translated({"config.json": json.dumps(settings_of(run))}).values
    said = {name: used[name] for name in ("grid_box", "truncation", "hash")}
    imported(run, tmp_path, said | {"bounds": [[-1.0] * 3, [1.0] * 3]})
    assert_exact(run, tmp_path)
    assert read_description(tmp_path / FIELD_NAME)["bounds"] == [[-1.0] * 3, [1.0] * 3]


@pytest.mark.parametrize(
    ("part", "key", "value", "reason"),
    [
        ("grid", "hash_size", 4, "SETTINGS_CONTRADICT_TENSORS"),
        ("grid", "enc", "DenseGrid", "FAMILY_NOT_SUPPORTED"),
        ("grid", "tcnn_encoding", False, "FAMILY_NOT_SUPPORTED"),
        ("grid", "voxel_sdf", 0, "SETTINGS_MALFORMED"),
        ("grid", "voxel_sdf", 1e-7, "SETTINGS_MALFORMED"),
        ("pos", "enc", "frequency", "FAMILY_NOT_SUPPORTED"),
        ("pos", "n_bins", 7, "SETTINGS_CONTRADICT_TENSORS"),
        ("decoder", "hidden_dim", 100, "SETTINGS_CONTRADICT_TENSORS"),
        ("mapping", "bound", [[0, 1], [0, 1]], "SETTINGS_MALFORMED"),
        ("mapping", "bound", [[0, 1], [0, 1], [2, -1]], "SETTINGS_MALFORMED"),
        ("data", "sc_factor", 0, "SETTINGS_MALFORMED"),
    ],
)
def test_settings_that_do_not_fit(
    part: str, key: str, value: object, reason: str, run: WrittenRun, tmp_path: Path
) -> None:
    values = settings_of(run)
    values[part][key] = value
    assert_refused(lambda: imported(run, tmp_path, settings=values), reason)


def test_the_finest_resolution_is_that_of_the_table() -> None:
    """Nine meters in voxels of 4 cm are 225 cells, or 224 by another rounding: the table's size tells."""
    values = {
        "mapping": {"bound": [[-0.1, 8.6], [-0.1, 8.9], [-0.3, 3.3]]},
        "training": {"trunc": 0.1},
        "grid": {"hash_size": 20, "voxel_sdf": 0.04},
    }
    found = {
        top: translated({"config.json": json.dumps(values)}, facts({"embed_fn.params": (rows * 2,)})).values["hash"]
        for top, rows in {225: _rows(225), 224: _rows(224)}.items()
    }
    assert {top: said["top_resolution"] for top, said in found.items()} == {225: 225, 224: 224}


def _rows(top: int) -> int:
    nodes = [int(np.ceil(16 * (top / 16) ** (level / 15) - 1 - 1e-6)) + 1 for level in range(16)]
    return sum(min(1 << 20, -(-(n**3) // 8) * 8) for n in nodes)
