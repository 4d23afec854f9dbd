"""MonoSDF's network with a grid: runs by a slow writer of its own, with their settings; and what is asked without."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.trainers.monosdf import write_monosdf
from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.readings_beside import AmbiguousError
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.importing.archives import assert_refused

STEPS = 15


def imported(
    run: WrittenRun, out: Path, said: dict[str, Any] | None = None, conf: Path | None = None
) -> dict[str, Any]:
    beside = Companions() if conf is None else Companions(settings=("runconf.conf", conf))
    return convert_file(run.checkpoint, out, said, ImportLimits(), beside=beside)


def conf_of(run: WrittenRun) -> Path:
    return next(run.folder.rglob("*.conf"))


def assert_exact(run: WrittenRun, out: Path) -> None:
    points = torch.tensor(np.random.default_rng(0).uniform(-run.reach, run.reach, (300, 3))).float()
    expected, slopes = run.reference(points)
    values, gradients = open_field(out / FIELD_NAME).signed_distance_and_gradient(points)
    assert float((values.double() - expected).abs().max()) < 1e-5 * float(expected.max() - expected.min())
    assert float((gradients.double() - slopes).norm(dim=1).quantile(0.99)) < 1e-3


def written(folder: Path, uses_grid: bool, seed: int = 20) -> WrittenRun:
    """The first run of a small grid from ``seed`` on that uses its grid, or does not."""
    for number in range(seed, seed + 200):
        run = write_monosdf(folder / str(number), np.random.default_rng(number), 0)
        sizes = run.settings["grid"]
        told = (sizes.base + 1) ** 3 < 1 << sizes.log2_size < 1 << 15  # the coarsest level tells its resolution
        if told and run.settings["use_grid_feature"] is uses_grid:
            return write_monosdf(folder / "chosen", np.random.default_rng(number), STEPS)
    raise AssertionError("no such run")


@pytest.mark.parametrize(("seed", "uses_grid"), [(20, True), (300, True), (600, False)])
def test_a_run_with_its_settings(seed: int, uses_grid: bool, tmp_path: Path) -> None:
    run = written(tmp_path, uses_grid, seed)
    report = imported(run, tmp_path, conf=conf_of(run))
    assert report["family"] == "monosdf"
    assert report["kind"] == ("grid_network" if uses_grid else "mlp")
    assert_exact(run, tmp_path)


def test_a_color_is_told_to_be_left_out(tmp_path: Path) -> None:
    run = written(tmp_path, True)
    checkpoint = torch.load(run.checkpoint, weights_only=False)
    state = next(value for value in checkpoint.values() if isinstance(value, dict))
    prefix = next(name for name in state if "implicit_network." in name).partition("implicit_network.")[0]
    state[f"{prefix}rendering_network.lin0.weight"] = torch.ones(3, 8)
    torch.save(checkpoint, tmp_path / "colored.pth")
    report = imported(replace(run, checkpoint=tmp_path / "colored.pth"), tmp_path, conf=conf_of(run))
    assert "COLOR_LEFT_OUT" in [warning.partition(":")[0] for warning in report["warnings"]]


def test_without_settings_the_reach_of_the_grid_is_asked(tmp_path: Path) -> None:
    run = written(tmp_path, True)
    with pytest.raises(AmbiguousError) as caught:
        imported(run, tmp_path)
    reaches = [one.say["hash"]["radius"] for one in caught.value.asked]
    assert reaches == [1.1, 1.0, 1.5, 5.0, 2.0, 2.5]
    boxes = [one.make().description["grid_box"][1][0] for one in caught.value.asked]
    assert boxes == reaches


def test_the_description_may_say_what_the_settings_do(tmp_path: Path) -> None:
    run = written(tmp_path, True)
    divisor, grid = run.settings.get("divide_factor", 1.5), run.settings["grid"]
    layout = {"radius": divisor, "base_resolution": grid.base, "top_resolution": grid.top}
    imported(run, tmp_path, {"hash": layout, "sign": 1})  # it may have begun as a room
    assert_exact(run, tmp_path)
    assert read_description(tmp_path / FIELD_NAME)["bounds"][1][0] == divisor


def test_an_unused_grid_needs_no_settings(tmp_path: Path) -> None:
    run = written(tmp_path, False)
    assert imported(run, tmp_path, {"sign": 1})["kind"] == "mlp"  # it may have begun as a room
    assert_exact(run, tmp_path)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("num_levels", 3), "SETTINGS_CONTRADICT_TENSORS"),
        (("divide_factor", -1.0), "SETTINGS_MALFORMED"),
        (("base_size", 9), "HASH_GRID_NOT_RECOGNIZED"),
        (("multires", 3), "SETTINGS_CONTRADICT_TENSORS"),
    ],
)
def test_settings_that_do_not_fit(change: tuple[str, float], reason: str, tmp_path: Path) -> None:
    run = written(tmp_path, True)
    conf = conf_of(run)
    lines = [line for line in conf.read_text().splitlines() if not line.strip().startswith(change[0])]
    at = next(i for i, line in enumerate(lines) if "use_grid_feature" in line)
    conf.write_text("\n".join([*lines[:at], f"{change[0]} = {change[1]}", *lines[at:]]))
    assert_refused(lambda: imported(run, tmp_path, conf=conf), reason)


def test_offsets_that_divide_nothing_are_refused(tmp_path: Path) -> None:
    run = written(tmp_path, True)
    checkpoint = torch.load(run.checkpoint, weights_only=True)
    state = checkpoint["model_state_dict"]
    name = next(key for key in state if key.endswith("offsets"))
    for offsets, reason in ((state[name] + 1, "TENSOR_SHAPE"), (state[name][[0, -1]], "TENSOR_SHAPE")):
        torch.save({"model_state_dict": state | {name: offsets}}, tmp_path / "odd.pth")
        with pytest.raises(FieldFormatError) as caught:
            convert_file(tmp_path / "odd.pth", tmp_path, None, ImportLimits())
        assert caught.value.reason == reason, json.dumps(str(caught.value))
