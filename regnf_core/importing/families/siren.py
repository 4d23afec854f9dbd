"""SIREN (Sitzmann et al. 2020) as its authors' code saves it: a bare state dictionary of a network of sines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import ConvertedField
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
from regnf_core.importing.families.network import FORM_ENTRIES, Form, Network, OpenForm, network_field, told
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "siren"
OMEGAS = (30.0, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 25.0, 35.0, 40.0, 45.0, 50.0, 60.0, 100.0)
_FIRST_OMEGAS = (10.0, 20.0, 30.0, 60.0)
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
    said = Form("sine").said(overrides)
    why = (
        f"keys {_PREFIX}*.0, {len(names)} layers",
        "bounds [-1, 1]: beyond the cube in which SIREN trains its sines repeat",
    )
    assumed = overrides.activation_scale is None
    forms = [OpenForm(sine_name(form), form, FAMILY, scale_is_open=assumed) for form in sine_forms(said, overrides)]
    converted = network_field(Network(layers), forms, shared_entries(overrides, UNIT_CUBE), why, assumed)
    return replace(converted, sign_is_open=overrides.sign is None)


def sine_forms(said: Form, overrides: UploadDescription) -> list[Form]:
    """The usual factors of a network of sines, the most usual first, but for those that the description says.

    The first layer's may be another than that of the rest.
    """
    if said.activation != "sine" or overrides.activation_scale is not None:
        return [said]
    scales = [replace(said, activation_scale=omega) for omega in OMEGAS]
    if said.first_activation_scale is not None:
        return scales
    firsts = [
        replace(form, first_activation_scale=first)
        for form in scales
        for first in _FIRST_OMEGAS
        if first != form.activation_scale
    ]
    return scales + firsts


def sine_name(form: Form) -> str:
    """What to say to get these factors."""
    if form.first_activation_scale is None:
        return told(activation_scale=form.scale)
    return told(activation_scale=form.scale, first_activation_scale=form.first_activation_scale)
