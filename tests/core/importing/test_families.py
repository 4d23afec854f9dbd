"""Small checkpoints of every family: recognized without a hint, and evaluated as their papers say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.schema.safe_format import read_description
from tests.core.fields.reference import central_differences
from tests.core.importing import small_families as small
from tests.core.importing.archives import assert_refused

INSTANT_GRID = {
    "hash": {"interpolation": "linear", "base_resolution": 16, "top_resolution": 2048, "features_per_level": 2},
    "activation": "softplus",
}
"""The table's layout, and what signs of twelve weights cannot tell."""
ANGELO_GRID = {"hash": {"base_resolution": 32, "top_resolution": 2048, "features_per_level": 2}}
NEUS_SAID, SIREN_SAID, DEEP_SAID = {"input_scale": 1.0}, {"activation_scale": 30.0}, {"output_tanh": 1}
"""What random networks, which are no distances, cannot tell by their behavior."""
CASES: dict[str, tuple[str, Callable[[], small.Sample], dict[str, Any]]] = {
    "neus": ("neus", small.neus, NEUS_SAID),
    "neus without frequencies": ("neus", lambda: small.neus(skip=1, multires=0), NEUS_SAID),
    "siren": ("siren", small.siren, SIREN_SAID),
    "deepsdf": ("deepsdf", small.deepsdf, DEEP_SAID | {"latent_index": 1}),
    "deepsdf's first shape": ("deepsdf", lambda: small.deepsdf(code=0), DEEP_SAID),
    "deepsdf, xyz in all": ("deepsdf", lambda: small.deepsdf(xyz_in_all=True), DEEP_SAID | {"latent_index": 1}),
    "deepsdf, layer norm": ("deepsdf", lambda: small.deepsdf(weight_norm=False), DEEP_SAID | {"latent_index": 1}),
    "deepsdf of one shape": ("deepsdf", lambda: small.deepsdf(width=0), DEEP_SAID),
    "instant-nsr-pl": ("instant_nsr_pl", small.instant_nsr_pl, INSTANT_GRID),
    "instant-nsr-pl, four levels": ("instant_nsr_pl", lambda: small.instant_nsr_pl(999, True), INSTANT_GRID),
    "instant-nsr-pl, five levels": ("instant_nsr_pl", lambda: small.instant_nsr_pl(1000, True), INSTANT_GRID),
    "instant-nsr-pl, all levels": ("instant_nsr_pl", lambda: small.instant_nsr_pl(9000, True), INSTANT_GRID),
    "neuralangelo": ("neuralangelo", small.neuralangelo, ANGELO_GRID),
    "neuralangelo, four levels": ("neuralangelo", lambda: small.neuralangelo(20_000), ANGELO_GRID),
    "neuralangelo, eight levels": ("neuralangelo", lambda: small.neuralangelo(20_000, 8), ANGELO_GRID),
    "neuralangelo, nine levels": ("neuralangelo", lambda: small.neuralangelo(50_000), ANGELO_GRID),
}


def imported(folder: Path, checkpoint: dict[str, Any], zipped: bool = True, **description: Any) -> dict[str, Any]:
    torch.save(checkpoint, folder / "upload", _use_new_zipfile_serialization=zipped)
    return convert_file(folder / "upload", folder, description, ImportLimits())


def assert_is(folder: Path, function: small.Function, scale: float = 1.0, sign: float = 1.0) -> None:
    """The field is sign * scale * function(x / scale), its gradient too."""
    points = np.random.default_rng(2).uniform(-0.9, 0.9, (25, 3)).astype(np.float32)
    field = open_field(folder / FIELD_NAME)
    distance, gradient = field.signed_distance_and_gradient(torch.from_numpy(points.astype(np.float64) * scale))
    exact = points.astype(np.float64)
    expected = sign * scale * np.array([function(point) for point in exact])
    slopes = sign * np.stack([central_differences(function, point, 1e-7) for point in exact])
    np.testing.assert_allclose(distance.numpy(), expected, atol=2e-5 * max(np.ptp(expected), scale))
    np.testing.assert_allclose(gradient.numpy(), slopes, atol=1e-3 * max(1.0, float(np.abs(slopes).max())))


@pytest.mark.parametrize("case", CASES)
def test_recognized_and_evaluated(case: str, tmp_path: Path) -> None:
    family, make, description = CASES[case]
    sample = make()
    report = imported(tmp_path, sample.checkpoint, **description)
    assert report["family"] == family
    assert_is(tmp_path, sample.function)


def _renamed(values: dict[str, Any], before: str) -> dict[str, Any]:
    """With this before the name of each tensor, in all dictionaries."""
    plain = {name.removeprefix("module."): value for name, value in values.items()}
    return {
        f"{before}{name}" if isinstance(value, torch.Tensor) else name: _renamed(value, before)
        if isinstance(value, dict) and name != "latent_codes"
        else value
        for name, value in plain.items()
    }


WRAPPERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "DataParallel": lambda values: _renamed(values, "module."),
    "compiled": lambda values: _renamed(values, "_orig_mod.module."),
    "a script's": lambda values: {"epoch": 3, "model_state_dict": values},
    "Lightning's": lambda values: {"state_dict": _renamed(values, "net."), "epoch": 3},
    "in a list": lambda values: [values, 3],
}


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("case", ["neus", "siren", "deepsdf", "instant-nsr-pl", "neuralangelo"])
def test_wrappers_of_a_network_say_nothing(case: str, wrapper: str, tmp_path: Path) -> None:
    family, make, description = CASES[case]
    sample = make()
    report = imported(tmp_path, WRAPPERS[wrapper](sample.checkpoint), **description)
    assert report["family"] == family
    assert_is(tmp_path, sample.function)


def test_one_network_of_several_is_asked_for(tmp_path: Path) -> None:
    state = small.siren().checkpoint
    assert_refused(lambda: imported(tmp_path, {"model": state, "ema": state}), "FIELD_NOT_RECOGNIZED")
    layers = small.neus().checkpoint["sdf_network_fine"]
    assert_refused(lambda: imported(tmp_path, {"state_dict": layers}), "FIELD_NOT_RECOGNIZED")
    assert imported(tmp_path, {"state_dict": layers}, family="neus", **NEUS_SAID)["family"] == "neus"


@pytest.mark.parametrize("case", ["neus", "deepsdf", "siren"])
def test_the_old_container_holds_the_same(case: str, tmp_path: Path) -> None:
    family, make, description = CASES[case]
    sample = make()
    assert imported(tmp_path, sample.checkpoint, zipped=False, **description)["family"] == family
    assert_is(tmp_path, sample.function)


def test_what_the_description_says_of_every_family(tmp_path: Path) -> None:
    """Distances and coordinates scale together; the sign turns; bounds are in the new unit."""
    sample = small.neus()
    report = imported(tmp_path, sample.checkpoint, **NEUS_SAID, world_scale=2.0, sign=-1, up_axis="z", label="pot")
    assert report["bounds"] == [[-2.0] * 3, [2.0] * 3]
    assert_is(tmp_path, sample.function, scale=2.0, sign=-1.0)
    description = read_description(tmp_path / FIELD_NAME)
    assert (description["up_axis"], description["label"]) == ("z", "pot")
    box = [[-1.5, -1.0, -1.0], [1.5, 1.0, 1.0]]
    assert imported(tmp_path, sample.checkpoint, **NEUS_SAID, world_scale=2.0, bounds=box)["bounds"] == box


def test_a_field_file_takes_its_bounds_along_to_another_unit(tmp_path: Path) -> None:
    sample = small.neus()
    imported(tmp_path, sample.checkpoint, **NEUS_SAID, world_scale=2.0, sign=-1)
    (tmp_path / FIELD_NAME).rename(tmp_path / "again")
    report = convert_file(tmp_path / "again", tmp_path, {"world_scale": 0.5, "sign": 1}, ImportLimits())
    assert report["bounds"] == [[-0.5] * 3, [0.5] * 3]
    assert_is(tmp_path, sample.function, scale=0.5)


def test_a_latent_code_may_come_from_the_description(tmp_path: Path) -> None:
    sample = small.deepsdf(code=2)
    code = sample.checkpoint.pop("latent_codes")["weight"][2]
    imported(tmp_path, sample.checkpoint, latent=code.tolist(), **DEEP_SAID)
    assert_is(tmp_path, sample.function)


@pytest.mark.parametrize("shape", [(3, 5), (3, 1, 5)])
def test_codes_saved_as_a_tensor(tmp_path: Path, shape: tuple[int, ...]) -> None:
    sample = small.deepsdf()
    sample.checkpoint["latent_codes"] = sample.checkpoint["latent_codes"]["weight"].reshape(shape)
    report = imported(tmp_path, sample.checkpoint, latent_index=1, **DEEP_SAID)
    assert "latent code 1 of 3 (counted from 0)" in report["why"]
    assert_is(tmp_path, sample.function)


@pytest.mark.parametrize(
    ("drop", "description", "reason"),
    [
        ("latent_codes", {}, "LATENT_MISSING"),
        ("latent_codes", {"latent_index": 1}, "LATENT_MISSING"),
        ("model_state_dict", {}, "FIELD_NOT_RECOGNIZED"),
        ("epoch", {"latent_index": 3}, "INVALID_DESCRIPTION"),
        ("epoch", {"latent": [0.0] * 4}, "INVALID_DESCRIPTION"),
        ("epoch", {"latent": [0.0] * 5, "latent_index": 0}, "INVALID_DESCRIPTION"),
        ("epoch", {"level_mask": 3}, "INVALID_DESCRIPTION"),
        ("epoch", {"family": "neus"}, "FAMILY_NOT_SUPPORTED"),
    ],
)
def test_codes_that_are_not_there(drop: str, description: dict[str, Any], reason: str, tmp_path: Path) -> None:
    values = small.deepsdf().checkpoint
    del values[drop]
    assert_refused(lambda: imported(tmp_path, values, **description), reason)


@pytest.mark.parametrize(
    ("make", "said", "bias", "scale"),
    [
        (lambda: small.instant_nsr_pl(50_000, True, active=4), {"level_mask": 4}, 0.0, 1.0),
        (lambda: small.instant_nsr_pl(relu=True), {"activation": "relu"}, 0.0, 1.0),
        (small.instant_nsr_pl, {"output_bias": 0.05, "output_scale": 0.5}, 0.05, 0.5),
    ],
)
def test_what_may_be_said_of_instant_nsr_pl(
    make: Callable[[], small.Sample], said: dict[str, Any], bias: float, scale: float, tmp_path: Path
) -> None:
    sample = make()
    imported(tmp_path, sample.checkpoint, **INSTANT_GRID | said)
    assert_is(tmp_path, lambda x: (sample.function(x) + bias) * scale)
    assert_refused(lambda: imported(tmp_path, sample.checkpoint, activation="sine"), "INVALID_DESCRIPTION")


def round_siren(sign: float, size: float = 0.6) -> dict[str, torch.Tensor]:
    """sign (3 - size - cos 1.2 x - cos 1.2 y - cos 1.2 z): a ball's worth round the origin, the other sign all about
    it."""
    first = {"net.net.0.0.weight": 1.2 / 30 * torch.eye(3), "net.net.0.0.bias": torch.full((3,), torch.pi / 60)}
    last = {"net.net.1.0.weight": -sign * torch.ones(1, 3), "net.net.1.0.bias": torch.tensor([(3.0 - size) * sign])}
    return first | last


@pytest.mark.parametrize(
    ("sign", "description", "uncertain"),
    [(1.0, {}, False), (-1.0, {}, True), (-1.0, {"sign": -1}, False), (-1.0, {"sign": 1}, False)],
)
def test_a_siren_that_is_negative_all_round_may_be_turned_round(
    sign: float, description: dict[str, Any], uncertain: bool, tmp_path: Path
) -> None:
    report = imported(tmp_path, round_siren(sign), **SIREN_SAID, **description)  # half of the cube
    assert ("SIGN_UNCERTAIN" in [warning.split(":")[0] for warning in report["warnings"]]) == uncertain


def test_a_small_thing_turned_inside_out_is_refused_unless_its_sign_is_said(tmp_path: Path) -> None:
    values = round_siren(-1.0, size=0.2)
    assert_refused(lambda: imported(tmp_path, values, **SIREN_SAID), "FIELD_IMPLAUSIBLE")
    for said in ({"sign": -1}, {"sign": 1}, {"as": "scene"}, {"accept_implausible": True}):
        imported(tmp_path, values, **SIREN_SAID, **said)
    imported(tmp_path, round_siren(1.0, size=0.2), **SIREN_SAID)


@pytest.mark.parametrize(
    ("make", "step", "words"),
    [
        (lambda: small.instant_nsr_pl(2500, True), "global_step", ["LEVEL_MASK_ASSUMED"]),
        (small.neuralangelo, "iteration", ["LEVEL_MASK_ASSUMED"]),
        (lambda: small.neuralangelo(20_000), None, ["LEVEL_MASK_ASSUMED"]),
        (small.neuralangelo, None, []),
        (lambda: small.instant_nsr_pl(2500, True), None, []),
    ],
)
def test_a_guess_at_the_open_levels_is_told(
    make: Callable[[], small.Sample], step: str | None, words: list[str], tmp_path: Path
) -> None:
    values = make().checkpoint
    if step is not None:
        values[step] = "many"
    grid = ANGELO_GRID if "model" in values else INSTANT_GRID
    report = imported(tmp_path, values, **grid)
    said = [warning.split(":")[0] for warning in report["warnings"]]
    assert [word for word in said if word not in ("GRADIENT_NOT_UNIT", "COLOR_LEFT_OUT")] == words
    assert step is not None or any("levels are in use" in why for why in report["why"])


def put(path: tuple[str, str], value: Any) -> Callable[[dict[str, Any]], None]:
    """Replace one tensor of a checkpoint; None takes it away."""

    def change(values: dict[str, Any]) -> None:
        state = values[path[0]] if path[0] else values
        state.pop(path[1], None)
        if value is not None:
            state[path[1]] = value

    return change


NEUS, SIREN, DEEP, INSTANT, ANGELO = "sdf_network_fine", "", "model_state_dict", "state_dict", "model"
SDF = "module.neural_sdf."


@pytest.mark.parametrize(
    ("make", "change", "reason"),
    [
        (small.neus, put((NEUS, "lin2.bias"), None), "TENSOR_MISSING"),
        (small.neus, put((NEUS, "lin2.bias"), torch.ones(2)), "TENSOR_SHAPE"),
        (small.neus, put((NEUS, "lin9.bias"), torch.ones(2)), "TENSOR_MISSING"),
        (small.neus, put((NEUS, "lin0.weight_v"), torch.ones(24, 20)), "TENSOR_SHAPE"),
        (small.neus, put((NEUS, "lin4.weight_v"), torch.ones(24, 40)), "TENSOR_SHAPE"),
        (small.neus, put((NEUS, "lin1.bias"), torch.full((24,), torch.inf)), "TENSOR_NOT_FINITE"),
        (small.siren, put((SIREN, "net.net.1.0.weight"), torch.ones(16, 17)), "TENSOR_SHAPE"),
        (small.siren, put((SIREN, "net.net.0.0.weight"), torch.ones(16, 2)), "TENSOR_SHAPE"),
        (small.siren, put((SIREN, "net.net.2.0.bias"), [0.0] * 16), "TENSOR_EXPECTED"),
        (small.deepsdf, put((DEEP, "module.lin1.weight_v"), torch.ones(16, 18)), "TENSOR_SHAPE"),
        (small.deepsdf, put((DEEP, "module.lin0.weight_v"), torch.ones(16, 2)), "TENSOR_SHAPE"),
        (small.deepsdf, put((DEEP, "module.bn1.weight"), torch.ones(16)), "TENSOR_MISSING"),
        (small.deepsdf, put(("latent_codes", "weight"), torch.ones(3, 4)), "TENSOR_SHAPE"),
        (small.deepsdf, put(("latent_codes", "weight"), None), "TENSOR_MISSING"),
        (small.instant_nsr_pl, put((INSTANT, "model.scene_aabb"), None), "TENSOR_MISSING"),
        (small.instant_nsr_pl, put((INSTANT, "model.scene_aabb"), torch.zeros(6)), "BOUNDS_INVALID"),
        (small.instant_nsr_pl, put((INSTANT, "model.scene_aabb"), torch.arange(6.0)), "BOUNDS_INVALID"),
        (small.instant_nsr_pl, put((INSTANT, "model.geometry.encoding.encoding.params"), None), "TENSOR_MISSING"),
        (small.instant_nsr_pl, put((INSTANT, "model.geometry.encoding.encoding.params"), torch.ones(9)), "HASH_GRID"),
        (small.neuralangelo, put((ANGELO, SDF + "tcnn_encoding.params"), None), "TENSOR_MISSING"),
        (small.neuralangelo, put((ANGELO, SDF + "tcnn_encoding.params"), torch.ones(9, 1)), "TENSOR_SHAPE"),
        (small.neuralangelo, put((ANGELO, SDF + "mlp.linear_sdf.weight"), None), "TENSOR_MISSING"),
        (small.neuralangelo, put((ANGELO, SDF + "mlp.linears.0.weight_g"), torch.ones(1, 1)), "TENSOR_SHAPE"),
    ],
)
def test_faulty_weights_are_refused(
    make: Callable[[], small.Sample], change: Callable[[dict[str, Any]], None], reason: str, tmp_path: Path
) -> None:
    values = make().checkpoint
    change(values)
    reason = {"HASH_GRID": "HASH_GRID_NOT_RECOGNIZED"}.get(reason, reason)
    assert_refused(lambda: imported(tmp_path, values), reason)
    assert not (tmp_path / FIELD_NAME).exists()


@pytest.mark.parametrize(
    "values",
    [
        {"state_dict": {"model.geometry.encoding_with_network.params": torch.ones(4)}},
        {"sdf_network_fine": {"lin0.bias": torch.ones(1)}},
        {"model": {f"{SDF}mlp.linears.0.bias": torch.ones(1)}},
    ],
)
def test_relatives_that_are_no_plain_network_are_refused_by_name(values: dict[str, Any], tmp_path: Path) -> None:
    assert_refused(lambda: imported(tmp_path, values), "FAMILY_NOT_SUPPORTED")
