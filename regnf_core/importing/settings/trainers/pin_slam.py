"""PIN-SLAM: the YAML of a run. The map's own object holds all that the function needs; here they are compared."""

from __future__ import annotations

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.pickle.pickle_machine import Placeholder
from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_NAMES = {
    "neuralpoints.voxel_size_m": "voxel_size_m",
    "neuralpoints.search_alpha": "search_alpha",
    "neuralpoints.num_nei_cells": "num_nei_cells",
    "neuralpoints.query_nn_k": "query_nn_k",
    "neuralpoints.weighted_first": "weighted_first",
    "loss.sigma_sigmoid_m": "sigma_sigmoid_m",
    "loss.main_loss_type": "main_loss_type",
}
"""Keys of the file by the attributes of the map's own configuration."""


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((keys for keys in mappings(documents) if isinstance(keys.find("neuralpoints"), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS."""
    said.put("family", "pin_slam", keys, "setting.name")
    config = said.facts.objects.get("neural_points", {}).get("config")
    held = config.state if isinstance(config, Placeholder) and isinstance(config.state, dict) else {}
    for path, attribute in _NAMES.items():
        value, found = keys.find(path), held.get(attribute)
        if value is None or not isinstance(found, (int, float, str)):
            continue
        same = value == found
        if isinstance(found, float):
            number = keys.number(path)
            same = number is not None and abs(number - found) <= 1e-6 * abs(found)
        if not same:
            raise contradiction(f"{keys.file}: {path}", value, found)
        said.note(keys, path)
