"""SIREN (Sitzmann et al. 2020) as its authors' code saves it: a bare state dictionary of a network of sines."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import Assumed, ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.families.network import (
    FORM_ENTRIES,
    Form,
    Network,
    form_variant,
    network_field,
    network_reading,
)
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "siren"
OMEGAS = (30.0, 20.0, 10.0, 15.0, 60.0, 1.0)
"""The factor in the authors' code, and others that are usual."""
_A_LITTLE = (0.97, 1.03)
_PREFIX = "net.net."


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE and what TensorSource raises.
    """
    state = strip_prefix(checkpoint, _PREFIX)
    if not state:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, FORM_ENTRIES)
    names = [f"{name}.0" for name in layer_names(state, "")]
    layers = read_layers(state, names, source, column=overrides.output_column or 0)
    if layers.input_width != 3:
        raise tensor_error(f"{_PREFIX}{names[0]} has {layers.input_width} columns, expected 3", "TENSOR_SHAPE")
    require_extra_columns(layers, names)
    network, form, entries = Network(layers), Form("sine").said(overrides), shared_entries(overrides, UNIT_CUBE)
    why = (
        f"keys {_PREFIX}*.0, {len(names)} layers",
        "bounds [-1, 1]: outside of the cube in which SIREN trains, its sines repeat",
    )
    converted = network_field(network, form, FAMILY, entries, why)
    if overrides.activation_scale is None:
        first, *others = (
            form_variant(network, replace(form, activation_scale=omega), FAMILY, entries, activation_scale=omega)
            for omega in OMEGAS
        )
        beside = tuple(partial(network_reading, FAMILY, network, near, entries) for near in _near(form))
        converted = replace(converted, assumed=Assumed(first.say, beside, tuple(others)))
    return replace(converted, sign_is_open=overrides.sign is None)


def _near(form: Form) -> Iterator[Form]:
    """With the factors a little off: the first layer's, the others', both."""
    first = form.first_activation_scale or form.scale
    for own, rest in itertools.product((1.0, *_A_LITTLE), repeat=2):
        if own != 1.0 or rest != 1.0:
            yield replace(form, first_activation_scale=own * first, activation_scale=rest * form.scale)
