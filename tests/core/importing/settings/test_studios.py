"""Configurations of sdfstudio and nerfstudio, by their names and numbers, as entries of a description."""

from __future__ import annotations

import json

import numpy as np
import pytest

from regnf_core.importing.settings.translate import merged
from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.configurations import studio
from tests.core.importing.settings.translating import facts, translated


def test_nerfstudio_and_sdfstudio() -> None:
    common = {
        "levels": 16,
        "features_per_level": 2,
        "log2_table_size": 19,
        "base_resolution": 16,
        "top_resolution": 2048,
    }
    found = translated({"config.yml": studio(True)})
    assert found.trainer == "nerfstudio"
    assert found.values == {
        "family": "nerfstudio_neus_facto",
        "use_grid": True,
        "hash": {**common, "interpolation": "smoothstep"},
        "positional_encoding": {"degree": 6, "two_pi": True},
        "contraction": "linf_grid",
    }
    found = translated({"config.yml": studio(False)})
    assert found.trainer == "sdfstudio"
    assert found.values == {
        "family": "sdfstudio_neus_facto",
        "use_grid": True,
        "hash": {**common, "interpolation": "smoothstep"},
        "positional_encoding": {"degree": 6, "used": True, "two_pi": False},
        "contraction": "none",
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
