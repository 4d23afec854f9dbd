"""Published configurations of trainers of hash grids: instant-nsr-pl and Neuralangelo."""

from __future__ import annotations

import json

import pytest

from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.configurations import ANGELO, BAND, nsr
from tests.core.importing.settings.translating import facts, translated

NSR_HASH = {
    "levels": 16,
    "features_per_level": 2,
    "log2_table_size": 19,
    "base_resolution": 32,
    "per_level_scale": 1.3195079107728942,
    "interpolation": "linear",
}


@pytest.mark.parametrize("name", ["neus-blender", "neus-dtu", "neus-dtu-wmask", "neus-colmap"])
def test_instant_nsr_pl(name: str) -> None:
    found = translated({f"{name}.yaml": nsr("HashGrid")}, facts(global_step=20000))
    assert found.values == {"family": "instant_nsr_pl", "activation": "softplus", "hash": NSR_HASH, "level_mask": 16}


@pytest.mark.parametrize(("step", "opened"), [(0, 4), (999, 4), (5000, 9), (20000, 16)])
def test_instant_nsr_pl_s_open_levels(step: int, opened: int) -> None:
    found = translated({"neuralangelo-dtu-wmask.yaml": nsr("ProgressiveBandHashGrid", BAND)}, facts(global_step=step))
    assert found.values["level_mask"] == opened


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
