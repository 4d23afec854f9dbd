"""Neuralangelo: config.yaml of a run, of which ``model.object.sdf`` counts, and transforms.json for the frame."""

from __future__ import annotations

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.facts import scaled_and_moved
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_SDF = "model.object.sdf"
_WARM_UP = 5000


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next((keys for keys in mappings(documents) if isinstance(keys.find(f"{_SDF}.encoding"), dict)), None)


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    network, encoding = keys.below(f"{_SDF}.mlp"), keys.below(f"{_SDF}.encoding")
    said.put("family", "neuralangelo", encoding, "type")
    if (encoding.text("type") or "hashgrid") != "hashgrid":
        said.refuse(encoding, "type")
    if (network.text("activ") or "softplus") != "softplus":
        said.refuse(network, "activ")
    if network.number("activ_params.beta") not in (None, 100.0):
        said.refuse(network, "activ_params.beta")
    if network.find("skip"):
        said.refuse(network, "skip")
    _grid(encoding, said)
    _open_levels(keys, encoding, said)
    first = said.facts.shape("neural_sdf.mlp.linears.0.bias")
    said.agree(network, "hidden_dim", first[0] if first else None)
    said.agree(network, "num_layers", said.facts.hidden_layers("neural_sdf.mlp.linears."))
    _frame(keys, said)


def _grid(encoding: Keys, said: Said) -> None:
    grid = encoding.below("hashgrid")
    said.put("hash.levels", encoding.whole("levels"), encoding, "levels")
    said.put("hash.features_per_level", grid.whole("dim"), grid, "dim")
    said.put("hash.log2_table_size", grid.whole("dict_size"), grid, "dict_size")
    for entry, key in (("hash.base_resolution", "min_logres"), ("hash.top_resolution", "max_logres")):
        exponent = grid.number(key)
        if exponent is not None and not 0 < exponent <= 20:
            raise grid.fault(key, "an exponent of 2 from 0 to 20")
        if exponent is not None:
            said.put(entry, round(2.0**exponent), grid, key)
    reach = grid.numbers("range")
    if reach is not None:
        if len(reach) != 2 or not 0 < reach[1] == -reach[0]:
            said.refuse(grid, "range")
        said.put("hash.radius", reach[1], grid, "range")
    said.values["hash.interpolation"] = "linear"


def _open_levels(keys: Keys, encoding: Keys, said: Said) -> None:
    levels, iteration = encoding.whole("levels"), said.facts.numbers.get("iteration")
    schedule = encoding.below("coarse2fine")
    if levels is None:
        return
    if not schedule.flag("enabled"):
        said.put("level_mask", levels, encoding, "levels")
    elif iteration is not None:
        every = max(schedule.whole("step") or _WARM_UP, 1)
        begin = keys.whole("optim.sched.warm_up_end")
        by_step = min(levels, max((iteration - (_WARM_UP if begin is None else begin)) // every, 1))
        said.put(
            "level_mask",
            min(max(schedule.whole("init_active_level") or 1, by_step), levels),
            schedule,
            "init_active_level",
        )
        said.note(schedule, "step")


def _frame(keys: Keys, said: Said) -> None:
    sphere = said.documents.named("transforms.json")
    if sphere is None:
        return
    center, radius = sphere.numbers("sphere_center", 3), sphere.number("sphere_radius")
    if center is None or len(center) != 3 or radius is None or not radius > 0:
        return
    shift, factor = keys.numbers("data.readjust.center", 3) or [0.0] * 3, keys.number("data.readjust.scale") or 1.0
    moved = [value + more for value, more in zip(center, shift, strict=False)]
    said.put("dataset_transform", scaled_and_moved(radius * factor, moved), sphere, "sphere_radius")
