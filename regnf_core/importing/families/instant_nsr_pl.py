"""instant-nsr-pl's NeuS: a hash grid over the scene's cube and a small network, in a Lightning checkpoint.

The network sees [x / r, grid((x + r) / 2r)] for a scene within [-r, r]^3. Its progressive grid opens a level every
thousand steps, from four on; how many are open is not saved, but the number of steps is.

Between the layers is softplus where the network began as a sphere, else ReLU. Trained networks of either behave alike
when they are read as the other, and differ by a percent of their range. But a sphere's last layer begins with weights
of one sign, and keeps them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape
from regnf_core.importing.families.color import instant_nsr_pl as color
from regnf_core.importing.families.color.head import with_color, with_deviation, with_hidden_factor
from regnf_core.importing.families.converted import ConvertedField, Reading, Variant, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces, space_readings, step_of
from regnf_core.importing.families.layers import (
    Layers,
    contradiction,
    folded_weight,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription

# Whether a network began as the distance to a sphere (Atzmon and Lipman 2020): what is left of it after training.

_TOSSES = 30
"""So many tosses of a coin that fall alike are no chance."""


def began_as_a_sphere(last: Float32Array) -> bool:
    """Whether the signs of the last layer's weights show it: all begin at sqrt(pi / width).

    Other starts give either sign alike. Training to distances, which grow outwards, prefers one sign in the distance's
    row, but in none of the features'. last: (rows, width), the distance's row first.
    """
    mostly = [float((row > 0).mean()) for row in (last[:1], last[1:]) if row.size]
    alike = len({share > 0.5 for share in mostly}) == 1
    return len(mostly) == 2 and alike and min(_tosses(last[:1]), _tosses(last[1:])) > _TOSSES


def _tosses(weights: Float32Array) -> float:
    """So many tosses of a coin fall alike as rarely as these signs are by chance, or more so (Chernoff's bound)."""
    share = min(0.5, 1.0 - float(max((weights > 0).mean(), (weights < 0).mean())))
    entropy = -sum(part * math.log2(part) for part in (share, 1.0 - share) if part > 0.0)
    return weights.size * (1.0 - entropy)


FAMILY = "instant_nsr_pl"
_PREFIX = "model.geometry."
_TABLE = "encoding.encoding.params"
_PROGRESSIVE_TABLE = "encoding.encoding.encoding.params"
_HABITS = GridHabits((2, 4, 8, 1), "linear", writes_growth=True)
_SHARPER = 1e4
"""ReLU is softplus of numbers so many times as large, but for 1e-6."""
_FIRST_LEVELS, _STEPS_A_LEVEL = 4, 1000


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, BOUNDS_INVALID,
    HASH_GRID_NOT_RECOGNIZED and what TensorSource raises.
    """
    state = strip_prefix(checkpoint.get("state_dict"), _PREFIX)
    if not state:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("level_mask", "hash", "activation", "output_scale", "output_bias"))
    layers = _said(_layers(state, source), overrides)
    bounds, radius = _scene_cube(checkpoint["state_dict"], source)
    if overrides.hash.radius not in (None, radius):
        raise contradiction("hash.radius", overrides.hash.radius, f"{radius:g} (scene_aabb)")
    table_name = _PROGRESSIVE_TABLE if _PROGRESSIVE_TABLE in state else _TABLE
    table = source.array(table_name, lookup(state, table_name))
    require_shape(table_name, table, (None,))
    spaces = find_spaces(table.size, layers.input_width - 3, _HABITS, overrides.hash)
    why = [f"keys {_PREFIX}*, {len(layers.weights)} layers", f"scene_aabb: the scene lies within {radius:g} of 0"]
    warnings: list[str] = []
    untold = _untold(state, layers, source, overrides, why, warnings)
    mask = overrides.level_mask
    if mask is None and table_name == _PROGRESSIVE_TABLE:
        mask = _open_levels(checkpoint, spaces[0].intervals[0].levels, why, warnings)
    entries = {
        **shared_entries(overrides, bounds),
        "grid_radius": radius,
        "level_mask": mask,
        "source": {"family": FAMILY},
    }
    how: Literal["open", "known"] = "open" if overrides.hash.interpolation is None else "known"
    readings = space_readings(table, spaces, _in_scene_units(layers, radius), entries, how)
    if overrides.activation == "relu":
        readings = tuple(_with_relu(reading) for reading in readings)
    converted = replace(converted_of(FAMILY, tuple(why), readings, tuple(warnings)), untold=untold)
    return _with_color(converted, checkpoint["state_dict"], len(layers.weights), source, overrides)


def _with_color(
    converted: ConvertedField, whole: dict[str, Any], count: int, source: TensorSource, overrides: UploadDescription
) -> ConvertedField:
    """With what the file has beside the geometry of ``count`` layers: the deviation, and the color."""
    converted = with_deviation(converted, whole, "model.variance.variance", source)
    if not color.has_color(whole) or overrides.color.keep is False:
        return converted
    state, last = strip_prefix(whole, _PREFIX), f"network.layers.{2 * count - 2}"
    factor = 1.0 / _SHARPER if overrides.activation == "relu" else 1.0
    return with_color(converted, lambda: color.read_color(whole, state, last, source, overrides.color), factor)


def _layers(state: dict[str, Any], source: TensorSource) -> Layers:
    """Linear layers have the even numbers; activations between them have the odd ones, and no parameters."""
    count = len({key.split(".")[2] for key in state if key.startswith("network.layers.")})
    if count < 2:
        message = "instant-nsr-pl without plain layers: it is a NeRF, or it uses tiny-cuda-nn's FullyFusedMLP"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    names = [f"network.layers.{2 * i}" for i in range(count)]
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names)
    if len(names) > 4:
        raise FieldFormatError(
            f"a geometry network with {len(names)} layers is not supported", reason="FAMILY_NOT_SUPPORTED"
        )
    return layers


def _untold(
    state: dict[str, Any],
    layers: Layers,
    source: TensorSource,
    overrides: UploadDescription,
    why: list[str],
    warnings: list[str],
) -> tuple[Variant, ...]:
    """Both activations where neither the description nor the weights tell which it is; what they tell goes to
    ``why``, and what holds for the trainer as it is published alone, to ``warnings``."""
    if overrides.output_bias is None and overrides.output_scale is None:
        why.append("sdf_bias and sdf_activation are not given: none is assumed")
    if overrides.activation is not None:
        return ()
    if not began_as_a_sphere(folded_weight(state, f"network.layers.{2 * len(layers.weights) - 2}", source)):
        return _ACTIVATIONS
    why.append("softplus: the weights of the last layer have one sign, as after initialization as a sphere")
    warnings.append(
        "ACTIVATION_ASSUMED: the trainer uses softplus in networks that are initialized as a sphere; if this one "
        "does not, give the import option activation: relu"
    )
    return ()


def _said(layers: Layers, overrides: UploadDescription) -> Layers:
    """The layers with what the settings say of them: (result + output_bias) output_scale."""
    if overrides.activation not in (None, "softplus", "relu"):
        message = f"description.activation: {overrides.activation} is not possible for {FAMILY}: softplus or relu"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
    scale = np.float32(overrides.output_scale or 1.0)
    (*weights, last), (*biases, last_bias) = layers.weights, layers.biases
    bias = (last_bias + np.float32(overrides.output_bias or 0.0)) * scale
    return Layers((*weights, last * scale), (*biases, bias))


def _with_relu(reading: Reading) -> Reading:
    """ReLU in place of softplus (``sphere_init: false``)."""
    last = max(int(name.split(".")[1]) for name in reading.tensors if name.startswith("layers."))
    factors = {"layers.0.weight": _SHARPER, f"layers.{last}.weight": 1.0 / _SHARPER}
    factors |= {f"layers.{layer}.bias": _SHARPER for layer in range(last)}
    sharper = {name: np.asarray(reading.tensors[name] * by, dtype=np.float32) for name, by in factors.items()}
    reading = replace(reading, tensors={**reading.tensors, **sharper})
    return with_hidden_factor(reading, reading.tensors[f"layers.{last}.weight"].shape[1], 1.0 / _SHARPER)


_ACTIVATIONS = (
    Variant("softplus between the layers", {"activation": "softplus"}, lambda reading: reading),
    Variant("ReLU between the layers", {"activation": "relu"}, _with_relu),
)


def _scene_cube(state: dict[Any, Any], source: TensorSource) -> tuple[list[list[float]], float]:
    """The scene's cube [-r, r]^3, and r."""
    box = source.array("model.scene_aabb", lookup(state, "model.scene_aabb"))
    require_shape("model.scene_aabb", box, (6,))
    radius = float(box.max())
    if radius <= 0.0 or not np.array_equal(box, np.repeat(np.array((-radius, radius), dtype=np.float32), 3)):
        raise FieldFormatError("the scene_aabb is not a cube around the origin", reason="BOUNDS_INVALID")
    return [[-radius] * 3, [radius] * 3], radius


def _open_levels(checkpoint: dict[Any, Any], levels: int, why: list[str], warnings: list[str]) -> int | None:
    """How many levels the progressive grid had opened by its last step."""
    step = step_of(checkpoint, "global_step")
    if step is None:
        warnings.append("LEVEL_MASK_ASSUMED: the checkpoint has no global_step; all levels are assumed to be in use")
        return None
    opened = min(_FIRST_LEVELS + step // _STEPS_A_LEVEL, levels)
    why.append(f"progressive grid, step {step}: {opened} of {levels} levels are in use")
    return opened


def _in_scene_units(layers: Layers, radius: float) -> dict[str, Float32Array]:
    """The layers for the position x itself instead of x / r."""
    first = layers.weights[0].copy()
    first[:, :3] /= np.float32(radius)
    return Layers((first, *layers.weights[1:]), layers.biases).tensors()
