"""MonoSDF's network with a hash grid (Yu et al. 2022): [x, sines and cosines, grid(x / d)] into softplus layers.

The grid is that of torch-ngp's kernel, interpolated by smoothstep, over [-d, d]^3. The file tells where each level
begins. It does not tell d, the ``divide_factor`` of the settings. A network that was trained without the grid has its
columns all the same, fed with zeros.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, tensor_error
from regnf_core.importing.families.converted import ConvertedField, Reading, Variant, converted_of
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    assumed_bounds,
    refuse_other_entries,
    require_family,
    shared_entries,
)
from regnf_core.importing.families.network import Form, Network, OpenForm, encoding_order, network_field
from regnf_core.importing.families.offset_grids import offset_readings, read_table
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "monosdf"
_ENTRIES = ("hash", "use_grid", "positional_encoding", "output_column")
_DIVISORS = (1.1, 1.0, 1.5, 5.0, 2.0, 2.5)
"""Those of the published configurations, the one of ScanNet's rooms first."""
_UNTRAINED = 1.01e-4
"""The trainer begins with features between -1e-4 and 1e-4."""


def convert_grid(
    state: dict[str, Any], layers: Layers, skips: tuple[int, ...], source: TensorSource, overrides: UploadDescription
) -> ConvertedField:
    """The field of the tensors below ``implicit_network.``, of which ``layers`` are read.

    skips: the layers that see the input again.
    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_SHAPE, HASH_GRID_NOT_RECOGNIZED,
    SETTINGS_CONTRADICT_TENSORS and what TensorSource raises.
    """
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, _ENTRIES)
    table = read_table(state, source, "encoding.", overrides.hash)
    degree, rest = divmod(layers.input_width - 3 - table.width, 6)
    if rest or degree < 0:
        columns = f"{layers.input_width} columns, expected 3 + 6 x frequencies + {table.width} of the grid"
        raise tensor_error(f"lin0 has {columns}", "TENSOR_SHAPE")
    form = Form("softplus", degree=degree, skip_factor=math.sqrt(0.5)).said(replace(overrides, output_column=None))
    why: tuple[str, ...] = (
        f"keys implicit_network.encoding.* and lin*, {len(layers.weights)} layers, {degree} frequencies",
    )
    is_trained = bool(np.abs(table.table).max() > _UNTRAINED)
    if overrides.use_grid is False or not is_trained or not _uses_grid(layers, skips, table.width):
        plain = Network(_without_grid(layers, skips, table.width), skips)
        why += ("the grid is not used" if overrides.use_grid is False else "the grid has no influence",)
        why += assumed_bounds(overrides)
        only = OpenForm("as the description says", form, FAMILY)
        return network_field(plain, [only], shared_entries(overrides, UNIT_CUBE), why)
    if len(skips) > 1:
        raise FieldFormatError("a grid's network with several skips is not supported", reason="FAMILY_NOT_SUPPORTED")
    ordered = _in_our_order(layers, skips, form, table.width)
    reach = overrides.hash.radius or _DIVISORS[0]
    entries = _entries(overrides, form, skips, reach)
    readings = offset_readings(table, ordered.tensors(), entries, overrides.hash, "smoothstep")
    if overrides.hash.radius is not None:
        return converted_of(FAMILY, (*why, f"the grid covers [-{reach:g}, {reach:g}]"), readings)
    return replace(converted_of(FAMILY, why, readings[:1]), untold=_divisors(overrides))


def _entries(overrides: UploadDescription, form: Form, skips: tuple[int, ...], reach: float) -> dict[str, Any]:
    box = [[-reach] * 3, [reach] * 3]
    encoding = {"degree": form.degree, "base_frequency": form.base_frequency}
    return {
        "kind": "grid_network",
        **shared_entries(overrides, box),
        "grid_box": box,
        "positional_encoding": encoding if form.degree else None,
        "skip_layer": skips[0] if skips else None,
        "source": {"family": FAMILY},
    }


def _divisors(overrides: UploadDescription) -> tuple[Variant, ...]:
    """What to ask where nothing says how far the grid reaches; whatever else is open is asked once that is said."""

    def over(reach: float, reading: Reading) -> Reading:
        box = [[-reach] * 3, [reach] * 3]
        around = shared_entries(overrides, box)["bounds"]
        return replace(reading, description={**reading.description, "grid_box": box, "bounds": around})

    return tuple(
        Variant(f"a grid over [-{r:g}, {r:g}] (divide_factor {r:g})", {"hash": {"radius": r}}, partial(over, r))
        for r in _DIVISORS
    )


def _uses_grid(layers: Layers, skips: tuple[int, ...], width: int) -> bool:
    """Whether the grid's features have any weight."""
    return any(bool(layers.weights[i][:, -width:].any()) for i in (0, *skips))


def _without_grid(layers: Layers, skips: tuple[int, ...], width: int) -> Layers:
    weights = [w[:, :-width] if i in (0, *skips) else w for i, w in enumerate(layers.weights)]
    return Layers(tuple(weights), layers.biases)


def _in_our_order(layers: Layers, skips: tuple[int, ...], form: Form, width: int) -> Layers:
    """[hidden, x, sines axis by axis, cosines axis by axis, grid] for the trainer's, frequency by frequency."""
    sines = encoding_order(form.order, form.degree, form.sines_width)

    def ordered(weight: Float32Array) -> Float32Array:
        start = weight.shape[1] - width - form.sines_width
        columns = np.concatenate((np.arange(start), start + sines, np.arange(weight.shape[1] - width, weight.shape[1])))
        return np.ascontiguousarray(weight[:, columns])

    weights = [ordered(w) if i in (0, *skips) else w for i, w in enumerate(layers.weights)]
    return Layers(tuple(weights), layers.biases)
