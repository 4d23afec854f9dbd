"""Configurations of trainers as entries of a description: beside the tensors, open levels, frames, what is refused.

test_published.py has the numbers that the trainers publish.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from regnf_core.importing.settings.translate import merged
from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.configurations import ANGELO, BAND, NEUS_CONF, SPECS, nsr, studio
from tests.core.importing.settings.translating import facts, linear, translated


def test_instant_nsr_pl_s_open_levels() -> None:
    files = {"neuralangelo-dtu-wmask.yaml": nsr("ProgressiveBandHashGrid", BAND)}
    steps = (0, 999, 5000, 20000)
    assert [translated(files, facts(global_step=step)).values["level_mask"] for step in steps] == [4, 4, 9, 16]


def test_instant_nsr_pl_s_other_functions() -> None:
    assert translated({"p.yaml": nsr("HashGrid", network="sphere_init: false")}).values["activation"] == "relu"
    biased = translated({"p.yaml": nsr("HashGrid", "    sdf_bias: 0.5\n    sdf_activation: mul2")}).values
    assert (biased["output_scale"], biased["output_bias"]) == (2.0, 0.5)  # (result + 0.5) 2
    for text in (
        nsr("VanillaFrequency"),
        nsr("HashGrid", "    sdf_activation: sigmoid"),
        nsr("HashGrid").replace("include_xyz: true", "include_xyz: false"),
        nsr("HashGrid").replace("VanillaMLP", "FullyFusedMLP"),
    ):
        assert_refused(lambda text=text: translated({"p.yaml": text}), "FAMILY_NOT_SUPPORTED")


@pytest.mark.parametrize(
    ("enabled", "first", "iteration", "opened"),
    [("True", 4, 0, 4), ("True", 8, 20_000, 8), ("True", 4, 40_000, 7), ("True", 4, 500_000, 16), ("False", 4, 0, 16)],
)
def test_neuralangelo(enabled: str, first: int, iteration: int, opened: int) -> None:
    found = translated({"config.yaml": ANGELO % (enabled, first)}, facts(iteration=iteration)).values
    assert found["level_mask"] == opened
    assert found["hash"] == {
        "levels": 16,
        "features_per_level": 8,
        "log2_table_size": 22,
        "base_resolution": 32,
        "top_resolution": 2048,
        "interpolation": "linear",
        "radius": 2.0,
    }


def test_neuralangelo_s_frame_and_refusals() -> None:
    sphere = json.dumps({"sphere_center": [1, 2, 3], "sphere_radius": 1.5, "frames": []})
    found = translated({"config.yaml": ANGELO % ("True", 4), "transforms.json": sphere})
    assert found.values["dataset_transform"] == [[3, 0, 0, 1], [0, 3, 0, 2], [0, 0, 3, 3], [0, 0, 0, 1]]
    for old, new in (("hashgrid,", "fourier,"), ("[-2,2]", "[-1,2]"), ("skip: []", "skip: [4]"), ("softplus", "relu_")):
        text = (ANGELO % ("True", 4)).replace(old, new)
        assert_refused(lambda text=text: translated({"config.yaml": text}), "FAMILY_NOT_SUPPORTED")


NEUS = linear("sdf_network_fine.lin", [256] * 3 + [217] + [256] * 4 + [257], [39] + [256] * 8)


def test_neus_in_a_report() -> None:
    name, scale = "thin_structure.conf", 3.0
    found = translated({name: NEUS_CONF.format(scale=scale, layers=8, skip=4)}, facts(NEUS))
    assert found.values == {
        "family": "neus",
        "positional_encoding": {"degree": 6},
        "input_scale": scale,
        "output_scale": 1 / scale,
    }
    assert found.why == (f"{name}: d_hidden 256, multires 6, scale {scale}, n_layers 8, skip_in [4]",)
    assert found.report() == {
        "trainer": "NeuS",
        "files": [name],
        "used": {"family": "neus", "positional_encoding.degree": 6, "input_scale": scale, "output_scale": 1 / scale},
    }


def test_neus_against_its_tensors() -> None:
    for layers, skip in ((7, 4), (8, 5), (8, "4, 5")):
        files = {"a.conf": NEUS_CONF.format(scale=1.0, layers=layers, skip=skip)}
        assert_refused(lambda files=files: translated(files, facts(NEUS)), "SETTINGS_CONTRADICT_TENSORS")


DEEPSDF = linear("model_state_dict.module.lin", [512] * 3 + [253] + [512] * 4 + [1], [259] + [512] * 8)


@pytest.mark.parametrize(
    "changed", [{"CodeLength": 128}, {"dims": [512] * 7}, {"latent_in": [3]}, {"xyz_in_all": True}, {"dims": [256] * 8}]
)
def test_deepsdf_against_its_tensors(changed: dict[str, Any]) -> None:
    specs = SPECS | {"NetworkSpecs": {**SPECS["NetworkSpecs"], **changed}} | changed  # type: ignore[dict-item]
    assert_refused(lambda: translated({"specs.json": json.dumps(specs)}, facts(DEEPSDF)), "SETTINGS_CONTRADICT_TENSORS")


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("model: {omega_0: 30}", {"activation_scale": 30.0}),
        (
            "network: {first_omega_0: 60, hidden_omega_0: 30}",
            {"first_activation_scale": 60.0, "activation_scale": 30.0},
        ),
        ("integrate: {voxel_size: 0.01, trunc_voxel_multiplier: 8}", {"truncation": 0.08}),
        ("sdf_trunc: 0.04", {"truncation": 0.04}),
    ],
)
def test_settings_of_no_trainer_in_particular(text: str, values: dict[str, float]) -> None:
    assert translated({"config.yaml": text}).values == values


def test_settings_that_nobody_knows() -> None:
    assert_refused(lambda: translated({"config.yaml": "a: 1"}), "SETTINGS_NOT_RECOGNIZED")
    found = translated({"config.yaml": "a: 1"}, required=False)
    assert (found.values, found.report()) == ({}, None)
    assert found.warnings[0].startswith("SETTINGS_NOT_USED: ")


def test_nerfstudio_and_sdfstudio() -> None:
    grid = {"levels": 16, "features_per_level": 2, "log2_table_size": 19, "base_resolution": 16, "top_resolution": 2048}
    for theirs, trainer, encoding, contraction in (
        (True, "nerfstudio", {"degree": 6, "two_pi": True}, "linf_grid"),
        (False, "sdfstudio", {"degree": 6, "used": True, "two_pi": False}, "none"),
    ):
        found = translated({"config.yml": studio(theirs)})
        assert found.trainer == trainer
        assert found.values == {
            "family": f"{trainer}_neus_facto",
            "use_grid": True,
            "hash": {**grid, "interpolation": "smoothstep"},
            "positional_encoding": encoding,
            "contraction": contraction,
        }


def test_sdfstudio_s_angelo_and_neus() -> None:
    angelo = studio(False, num_layers=1, use_position_encoding=False, hash_smoothstep=False, hash_features_per_level=8)
    values = translated({"config.yml": angelo}).values
    assert values["family"] == "sdfstudio_neus_facto_angelo"
    assert values["positional_encoding"]["used"] is False
    assert (values["hash"]["features_per_level"], values["hash"]["interpolation"]) == (8, "linear")
    values = translated({"config.yml": studio(False, num_layers=8, use_grid_feature=False)}).values
    assert (values["family"], values["use_grid"]) == ("sdfstudio_neus", False)


def test_levels_that_training_had_not_opened_are_warned_of() -> None:
    text = studio(False) + "    enable_progressive_hash_encoding: true\n    level_init: 4\n"
    found = translated({"config.yml": text}, facts(step=60000))
    assert "level_mask" not in found.values
    assert [warning.partition(":")[0] for warning in found.warnings] == ["LEVEL_MASK_ASSUMED"]
    assert "7 of 16" in found.warnings[0]
    assert translated({"config.yml": text}, facts(step=500000)).warnings == ()


def test_the_frames_of_nerfstudio_and_sdfstudio() -> None:
    moved = json.dumps({"transform": [[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 0]], "scale": 0.5})
    found = translated({"config.yml": studio(True), "dataparser_transforms.json": moved}).values["dataset_transform"]
    np.testing.assert_allclose(found, [[0, 2, 0, 0], [-2, 0, 0, 2], [0, 0, 2, 0], [0, 0, 0, 1]], atol=1e-12)
    identity = json.dumps({"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0})
    turned = studio(True).replace("auto_orient: false", "auto_orient: true")
    assert "dataset_transform" not in translated({"config.yml": turned, "dataparser_transforms.json": identity}).values
    world = json.dumps({"worldtogt": [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]})
    found = translated({"config.yml": studio(False), "meta_data.json": world}).values["dataset_transform"]
    assert found == [[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    turned = studio(False).replace("auto_orient: false", "center_poses: true")
    assert "dataset_transform" not in translated({"config.yml": turned, "meta_data.json": world}).values


@pytest.mark.parametrize("value", ["sixteen", "[16]", "{a: 1}", "true", "1.5", ".nan", "0", "99999999999999999999"])
def test_values_that_no_trainer_writes(value: str) -> None:
    text = studio(False).replace("num_levels: 16", f"num_levels: {value}")
    assert_refused(lambda: translated({"config.yml": text}), "SETTINGS_MALFORMED")


def test_what_the_caller_says_goes_before() -> None:
    by_settings = translated({"config.yml": studio(False)}).values
    both = merged({"hash": {"per_level_scale": 1.5, "levels": 8}, "use_grid": False, "label": "a"}, by_settings)
    assert both["hash"] == {
        "levels": 8,
        "features_per_level": 2,
        "log2_table_size": 19,
        "base_resolution": 16,
        "per_level_scale": 1.5,
        "interpolation": "smoothstep",
    }
    assert (both["use_grid"], both["label"], both["contraction"]) == (False, "a", "none")
    assert merged({"world_scale": 2.0}, {"bounds": [[-1] * 3, [1] * 3]})["bounds"] == [[-2.0] * 3, [2.0] * 3]
    assert "latent_index" not in merged({"latent_index": 3}, {"latent": [0.5]})
