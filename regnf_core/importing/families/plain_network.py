"""A network of plain layers of any trainer, under any names: what stands between its layers is found by evidence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    find_chains,
    read_layers,
    refuse_other_entries,
    require_family,
    shared_entries,
    states,
)
from regnf_core.importing.families.network import FORM_ENTRIES, Form, Network, OpenForm, Order, network_field, told
from regnf_core.importing.families.siren import OMEGAS
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "plain_network"
_ACTIVATIONS: tuple[tuple[str, float | None], ...] = (
    ("relu", None),
    ("softplus", 100.0),
    ("softplus", 1.0),
    ("softplus", 10.0),
    ("leaky_relu", 0.01),
    ("leaky_relu", 0.1),
    ("leaky_relu", 0.2),
    ("tanh", None),
    ("elu", None),
    ("gelu", None),
    ("silu", None),
)
_ORDERS: tuple[Order, ...] = ("frequency", "kind", "kind_frequency", "axis")
_FREQUENCIES = (1.0, math.pi, 2.0 * math.pi)
_SKIP_FACTORS = (1.0, math.sqrt(0.5))
MAX_DEGREE = 24


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of a checkpoint that holds one chain of linear layers, or None where there is none.

    Raises FieldFormatError: FIELD_NOT_RECOGNIZED (several such networks, or one of other inputs than positions) and
    what the layers and the description are refused for.
    """
    found = [(where, state, chain) for where, state in states(checkpoint) for chain in find_chains(state)]
    if not found:
        return None
    if len(found) > 1:
        names = [f"{where}.{chain.where}".strip(".")[:40] for where, _, chain in found[:4]]
        message = f"several networks ({', '.join(names)}), and nothing says which is the distance: save that one alone"
        raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")
    ((where, state, chain),) = found
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, FORM_ENTRIES)
    layers = read_layers(state, chain.names, source, None, overrides.output_column or 0)
    place = f" under {where}" if where.isprintable() and where else ""
    told = f"a chain of {len(chain.names)} linear layers{place}, of {chain.input_width} numbers"
    return replace(plain_field(layers, chain.skips, told, overrides), sign_is_open=overrides.sign is None)


def plain_field(
    layers: Layers, skips: tuple[int, ...], recognized: str, overrides: UploadDescription
) -> ConvertedField:
    """The field of these layers in every form that the description leaves open.

    Raises FieldFormatError: FIELD_NOT_RECOGNIZED, SETTINGS_CONTRADICT_TENSORS, INVALID_DESCRIPTION.
    """
    network = Network(layers, skips)
    forms = list(open_forms(network, degree_of(layers.input_width), overrides))
    if not forms:
        raise FieldFormatError("description: no network of plain layers is so", reason="INVALID_DESCRIPTION")
    why = (recognized, "bounds [-1, 1]: assumed; say bounds if the field's region is another")
    return network_field(network, forms, shared_entries(overrides, UNIT_CUBE), why)


def degree_of(width: int) -> int:
    """Frequencies of the encoding that gives so many columns. Raises FieldFormatError (FIELD_NOT_RECOGNIZED)."""
    degree, rest = divmod(width, 6)
    if rest not in (0, 3) or degree > MAX_DEGREE or width == 0:
        message = f"a network of plain layers that sees {width} numbers: 3 are taken, or 3 + 6 for each frequency"
        raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")
    return degree


def open_forms(network: Network, degree: int, overrides: UploadDescription) -> Iterator[OpenForm]:
    """Every usual form that the description leaves open, the most usual first, each with what to say to get it."""
    orders = _ORDERS if degree > 1 else ("frequency", "axis") if degree else ("frequency",)
    seen = set()
    for order, frequency, factor, first, (activation, scale), tanh in product(
        orders,
        _FREQUENCIES if degree else (1.0,),
        _SKIP_FACTORS if network.skips else (1.0,),
        (False, True) if network.skips else (False,),
        (*_ACTIVATIONS, *(("sine", omega) for omega in OMEGAS if not degree)),
        (0, 1),
    ):
        if not _may_be(overrides, activation, scale, tanh):
            continue
        base = Form(
            activation,
            scale,
            degree=degree,
            order=order,
            base_frequency=frequency,
            skip_factor=factor,
            input_first=first,
            output_tanh=tanh,
        )
        form = base.said(overrides)
        if form not in seen:
            seen.add(form)
            name = _told(form, bool(network.skips))
            yield OpenForm(name, form, FAMILY, scale_is_open=overrides.activation_scale is None)


def _may_be(overrides: UploadDescription, activation: str, scale: float | None, tanh: int) -> bool:
    """Whether what the description says has a meaning for such a form."""
    said = overrides.activation_scale
    if overrides.activation not in (None, activation):
        return False
    if (
        said is not None
        and overrides.activation is None
        and (scale is None or (activation == "leaky_relu" and said > 1.0))
    ):
        return False
    if overrides.first_activation_scale is not None and overrides.activation is None and activation != "sine":
        return False
    scaled = overrides.output_scale is not None or overrides.output_bias is not None
    return not (scaled and tanh and overrides.output_tanh is None)


def _told(form: Form, skips: bool) -> str:
    entries: dict[str, object] = {"activation": form.activation}
    if form.activation_scale is not None:
        entries["activation_scale"] = form.activation_scale
    entries["output_tanh"] = form.output_tanh
    if form.degree:
        entries["positional_encoding"] = {"order": form.order, "base_frequency": form.base_frequency}
    if skips:
        entries["skip_factor"] = form.skip_factor
        entries["skip_order"] = "input_first" if form.input_first else "hidden_first"
    return told(**entries)
