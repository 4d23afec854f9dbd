"""Published configurations of trainers of plain layers: NeuS, DeepSDF."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.configurations import NEUS_CONF, SPECS
from tests.core.importing.settings.translating import facts, linear, translated

NEUS = linear("sdf_network_fine.lin", [256] * 3 + [217] + [256] * 4 + [257], [39] + [256] * 8)


@pytest.mark.parametrize(
    ("name", "scale"),
    [("womask.conf", 1.0), ("wmask.conf", 1.0), ("thin_structure.conf", 3.0), ("womask_dtu_large_roi.conf", 3.0)],
)
def test_neus(name: str, scale: float) -> None:
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


@pytest.mark.parametrize(("layers", "skip", "reason"), [(7, 4, "TENSORS"), (8, 5, "TENSORS"), (8, "4, 5", "TENSORS")])
def test_neus_against_its_tensors(layers: int, skip: object, reason: str) -> None:
    files = {"a.conf": NEUS_CONF.format(scale=1.0, layers=layers, skip=skip)}
    assert_refused(lambda: translated(files, facts(NEUS)), f"SETTINGS_CONTRADICT_{reason}")


DEEPSDF = linear("model_state_dict.module.lin", [512] * 3 + [253] + [512] * 4 + [1], [259] + [512] * 8)


@pytest.mark.parametrize("name", ["chairs", "lamps", "planes", "sofas", "tables"])
def test_deepsdf(name: str) -> None:
    specs = SPECS | {"Description": name}
    assert translated({"specs.json": json.dumps(specs)}, facts(DEEPSDF)).values == {
        "family": "deepsdf",
        "output_tanh": 1,
    }
    specs["NetworkSpecs"] = {**SPECS["NetworkSpecs"], "use_tanh": True}  # type: ignore[dict-item]
    assert translated({"specs.json": json.dumps(specs)}, facts(DEEPSDF)).values["output_tanh"] == 2


@pytest.mark.parametrize(
    "changed", [{"CodeLength": 128}, {"dims": [512] * 7}, {"latent_in": [3]}, {"xyz_in_all": True}, {"dims": [256] * 8}]
)
def test_deepsdf_against_its_tensors(changed: dict[str, Any]) -> None:
    specs = SPECS | {"NetworkSpecs": {**SPECS["NetworkSpecs"], **changed}} | changed  # type: ignore[dict-item]
    assert_refused(lambda: translated({"specs.json": json.dumps(specs)}, facts(DEEPSDF)), "SETTINGS_CONTRADICT_TENSORS")
