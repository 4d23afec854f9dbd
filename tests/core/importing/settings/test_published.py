"""The configurations that trainers publish, each translated to a description.

``published_configurations.json`` has what their repositories' files say of the geometry network, by file name.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.core.importing.settings.translating import facts, translated

_PUBLISHED = json.loads((Path(__file__).parent / "published_configurations.json").read_text())


def configurations(*trainers: str) -> list[Any]:
    found = [(trainer, *one) for trainer in trainers for one in _PUBLISHED[trainer].items()]
    return [pytest.param(name, values, id=f"{trainer} {name}") for trainer, name, values in found]


def hocon(values: dict[str, Any]) -> str:
    """As such files are written, with Python's words for true and false."""
    return "\n".join(f"  {key} = {value}" for key, value in values.items())


@pytest.mark.parametrize(("name", "values"), configurations("neus"))
def test_neus(name: str, values: dict[str, Any]) -> None:
    said = translated({name: f"model {{\n sdf_network {{\n{hocon(values)}\n }}\n}}"}).values
    assert said == {
        "family": "neus",
        "positional_encoding": {"degree": values["multires"]},
        "input_scale": values["scale"],
        "output_scale": 1 / values["scale"],
    }


@pytest.mark.parametrize(("name", "values"), configurations("deepsdf"))
def test_deepsdf(name: str, values: dict[str, Any]) -> None:
    said = translated({"specs.json": json.dumps(values | {"Description": name})}).values
    assert said == {"family": "deepsdf", "output_tanh": 1 + values["NetworkSpecs"]["use_tanh"]}


@pytest.mark.parametrize(("name", "values"), configurations("instant_nsr_pl"))
def test_instant_nsr_pl(name: str, values: dict[str, Any]) -> None:
    text = yaml.safe_dump({"model": {"name": "neus", "radius": values["radius"], "geometry": values["geometry"]}})
    grid = values["geometry"]["xyz_encoding_config"]
    said = translated({name: text}, facts(global_step=2500)).values
    assert said["hash"] == {
        "levels": grid["n_levels"],
        "features_per_level": grid["n_features_per_level"],
        "log2_table_size": grid["log2_hashmap_size"],
        "base_resolution": grid["base_resolution"],
        "per_level_scale": grid["per_level_scale"],
        "interpolation": "linear",
    }
    opened = grid["start_level"] + 2500 // grid["update_steps"] if "start_level" in grid else grid["n_levels"]
    assert said["level_mask"] == min(opened, grid["n_levels"])


@pytest.mark.parametrize(("name", "values"), configurations("neuralangelo"))
def test_neuralangelo(name: str, values: dict[str, Any]) -> None:
    tree = {"model": {"object": {"sdf": values}}, "optim": {"sched": {"warm_up_end": 5000}}}
    said = translated({name: yaml.safe_dump(tree)}, facts(iteration=5000)).values
    grid = values["encoding"]["hashgrid"]
    assert said["level_mask"] == values["encoding"]["coarse2fine"]["init_active_level"]
    assert said["hash"]["base_resolution"] == 1 << grid["min_logres"]
    assert said["hash"]["top_resolution"] == 1 << grid["max_logres"]
    assert (said["hash"]["features_per_level"], said["hash"]["log2_table_size"]) == (grid["dim"], grid["dict_size"])


@pytest.mark.parametrize(("name", "values"), configurations("pin_slam"))
def test_pin_slam(name: str, values: dict[str, Any]) -> None:
    """Its map holds what the function needs; without the map there is nothing to compare."""
    assert translated({name: yaml.safe_dump({"setting": {"name": "a"}, **values})}).values == {"family": "pin_slam"}
