"""The configurations that ten trainers publish, each translated to a description.

``published_configurations.json`` has what their repositories' files say of the geometry network, by file name.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.translating import facts, translated

MONOSDF_GRID = {
    "levels": 16,
    "features_per_level": 2,
    "log2_table_size": 19,
    "base_resolution": 16,
    "top_resolution": 2048,
}
"""Its files leave the layout out: these are the trainer's defaults."""
MONOSDF_ROWS = sum(min(1 << 19, (math.ceil(16 * 128 ** (level / 15)) + 1) ** 3) for level in range(16))
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


@pytest.mark.parametrize(("name", "values"), configurations("idr", "volsdf", "monosdf"))
def test_implicit_networks(name: str, values: dict[str, Any]) -> None:
    network, sphere = values["implicit_network"], values["scene_bounding_sphere"]
    where = "" if sphere is None else f" scene_bounding_sphere = {sphere}\n"
    text = f"model{{\n{where} implicit_network\n {{\n{hocon(network)}\n }}\n}}"
    expected: dict[str, Any] = {"positional_encoding": {"degree": network["multires"]}}
    if sphere is not None:
        expected["bounds"] = [[-sphere] * 3, [sphere] * 3]
    if network.get("inside_outside"):
        expected["sign"] = 1  # a room, as it should be
    if "use_grid_feature" in network:
        expected |= {
            "use_grid": network["use_grid_feature"],
            "hash": MONOSDF_GRID | {"radius": network["divide_factor"]},
        }
    known = facts({"implicit_network.encoding.embeddings": (MONOSDF_ROWS, 2)} if "use_grid_feature" in network else {})
    assert translated({name: text}, known).values == expected


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


@pytest.mark.parametrize(("name", "values"), configurations("isdf"))
def test_isdf(name: str, values: dict[str, Any]) -> None:
    said = translated({"config.json": json.dumps({"dataset": {"format": name}, "model": values})}).values
    scales = {"input_scale": values["embedding"]["scale_input"], "output_scale": values["scale_output"]}
    assert said == {"family": "isdf", **scales}
    values = values | {"embedding": values["embedding"] | {"gauss_embed": 1}}
    assert_refused(lambda: translated({"config.json": json.dumps({"model": values})}), "FAMILY_NOT_SUPPORTED")


@pytest.mark.parametrize(("name", "values"), configurations("pin_slam"))
def test_pin_slam(name: str, values: dict[str, Any]) -> None:
    """Its map holds what the function needs; without the map there is nothing to compare."""
    assert translated({name: yaml.safe_dump({"setting": {"name": "a"}, **values})}).values == {"family": "pin_slam"}


@pytest.mark.parametrize(("name", "values"), configurations("co_slam"))
def test_co_slam(name: str, values: dict[str, Any]) -> None:
    """Each scene's file with that of its dataset, as the trainer writes them to a run's config.json."""
    said = translated({"config.json": json.dumps(values)}).values
    bound, grid = values["mapping"]["bound"], values["grid"]
    assert said["grid_box"] == [[low for low, _ in bound], [high for _, high in bound]]
    assert said["truncation"] == values["training"]["trunc"] * values["data"]["sc_factor"]
    cells = max(high - low for low, high in bound) / grid["voxel_sdf"]
    assert abs(said["hash"]["top_resolution"] - cells + 0.5) <= 0.5 + 1e-6
    assert said["hash"]["log2_table_size"] == grid["hash_size"]
