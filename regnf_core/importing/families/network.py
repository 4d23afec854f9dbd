"""A network of plain layers as a stored field: its form's constant factors folded in, its columns in our order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array
from regnf_core.importing.families.converted import ConvertedField, Reading, Variant
from regnf_core.importing.families.layers import Layers, contradiction, require_extra_columns
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.kinds import LEAKY_SLOPE

OMEGA, BETA = 30.0, 100.0
"""The usual factors of a sine's argument and of softplus's."""
_USUAL_SCALES = {"softplus": BETA, "sine": OMEGA, "leaky_relu": LEAKY_SLOPE}
FORM_ENTRIES = (
    "activation",
    "activation_scale",
    "first_activation_scale",
    "input_scale",
    "output_scale",
    "output_bias",
    "output_column",
    "output_tanh",
    "positional_encoding",
    "skip_factor",
    "skip_order",
)
"""Entries of a description that say what form a network of plain layers has."""

Order = Literal["frequency", "kind", "kind_frequency", "axis"]
"""How an encoding's columns are sorted. frequency: for each frequency three sines, three cosines. kind: all sines, axis
by axis, then all cosines. kind_frequency: the same, frequency by frequency. axis: for each axis, for each frequency,
the sine and the cosine."""


@dataclass(frozen=True)
class Form:
    """What the tensors of a network do not say: x -> input_scale x -> encoding -> layers -> tanh -> factor and bias."""

    activation: str
    activation_scale: float | None = None
    """Softplus's beta, the sine's omega, leaky_relu's slope; None: the usual."""
    first_activation_scale: float | None = None
    """The first layer's, if it is another."""
    degree: int = 0
    order: Order = "frequency"
    base_frequency: float = 1.0
    skip_factor: float = 1.0
    """Of [hidden, input] where a layer sees the input again."""
    input_first: bool = False
    """Whether those layers see [input, hidden] instead."""
    input_scale: float = 1.0
    output_scale: float = 1.0
    output_bias: float = 0.0
    """Added to the result before it is multiplied."""
    output_tanh: int = 0

    @property
    def scale(self) -> float:
        """The activation's factor, the usual one where none is said."""
        return self.activation_scale or _USUAL_SCALES.get(self.activation, 1.0)

    def said(self, overrides: UploadDescription) -> Form:
        """This form with what the description says of it. Raises FieldFormatError (INVALID_DESCRIPTION)."""
        names = [name for name in FORM_ENTRIES if hasattr(self, name) and getattr(overrides, name) is not None]
        form = replace(self, **{name: getattr(overrides, name) for name in names})
        encoding = overrides.positional_encoding
        if encoding.degree is not None and encoding.degree != self.degree:
            raise contradiction("positional_encoding.degree", encoding.degree, self.degree)
        if encoding.two_pi is not None:
            form = replace(form, base_frequency=2.0 * math.pi if encoding.two_pi else 1.0)
        form = replace(form, base_frequency=encoding.base_frequency or form.base_frequency)
        form = replace(form, order=encoding.order or form.order)
        if overrides.skip_order is not None:
            form = replace(form, input_first=overrides.skip_order == "input_first")
        if form.activation not in _USUAL_SCALES and form.activation_scale is not None:
            raise _invalid("activation_scale", f"is not possible for {form.activation}")
        if form.activation != "sine" and form.first_activation_scale is not None:
            raise _invalid("first_activation_scale", f"is not possible for {form.activation}")
        if form.activation == "leaky_relu" and form.scale > 1.0:
            raise _invalid("activation_scale", "a slope of leaky_relu is at most 1")
        if form.output_tanh and (form.output_scale != 1.0 or form.output_bias):
            raise _invalid("output_scale", "and output_bias are not possible after a tanh")
        return form


@dataclass(frozen=True)
class Network:
    """Layers as a checkpoint has them. Those in ``skips`` see the input again; ``norms``: tensors of normalizations."""

    layers: Layers
    skips: tuple[int, ...] = ()
    norms: Mapping[str, Float32Array] = field(default_factory=dict)


def network_reading(family: str, network: Network, form: Form, entries: Mapping[str, Any]) -> Reading:
    """The field of kind ``mlp``. entries: those that all kinds share."""
    tensors = _folded(network, form)
    normalized = sorted({int(name.split(".")[1]) for name in network.norms})
    description = {
        "kind": "mlp",
        **entries,
        "activation": form.activation,
        "input_at": list(network.skips),
        "normalized": normalized,
        "output_tanh": form.output_tanh,
        "source": {"family": family},
    }
    if form.activation == "leaky_relu":
        description["negative_slope"] = form.scale
    if form.degree:
        frequency = form.base_frequency * form.input_scale
        description["positional_encoding"] = {"degree": form.degree, "base_frequency": frequency, "off_axis": False}
    return Reading(family, description, tensors)


def network_field(
    network: Network, form: Form, family: str, entries: Mapping[str, Any], why: tuple[str, ...]
) -> ConvertedField:
    reading = network_reading(family, network, form, entries)
    return ConvertedField(family, why, reading.description, reading.tensors)


def form_variant(network: Network, form: Form, family: str, entries: Mapping[str, Any], **say: object) -> Variant:
    """The network in another form; ``say``: the entries of a description that choose it."""
    name = ", ".join(f"{key} {value}" for key, value in say.items())
    return Variant(name, say, lambda _: network_reading(family, network, form, entries))


def _folded(network: Network, form: Form) -> dict[str, Float32Array]:
    """The layers' tensors, every factor of the form in them."""
    layers, last = network.layers, len(network.layers.weights) - 1
    before = form.scale / BETA if form.activation == "softplus" else 1.0  # of what the activation is given
    tensors: dict[str, Float32Array] = {}
    norms = dict(network.norms)
    for i, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        if i == 0 or i in network.skips:
            weight = _in_our_order(weight, layers.input_width, form, first=i == 0)
        columns = _column_factors(weight.shape[1], network, i, form, 1.0 / before)
        rows = _row_factor(form, i, before) if i < last else form.output_scale
        if f"norms.{i}.weight" in norms:
            for part in ("weight", "bias"):
                norms[f"norms.{i}.{part}"] = _times(norms[f"norms.{i}.{part}"], rows)
            rows = 1.0
        if i == last and form.output_bias:
            bias = np.asarray(bias + np.float32(form.output_bias), dtype=np.float32)
        tensors[f"layers.{i}.weight"] = _times(weight, rows * columns)
        tensors[f"layers.{i}.bias"] = _times(bias, rows)
    return tensors | norms


def _row_factor(form: Form, layer: int, before: float) -> float:
    if form.activation != "sine":
        return before
    return form.first_activation_scale or form.scale if layer == 0 else form.scale


def _column_factors(width: int, network: Network, layer: int, form: Form, after: float) -> npt.NDArray[np.float64]:
    """Of each column of a layer: hidden ones by ``after``, the position by the input's scale, a skip by its factor."""
    inputs = 3 + 6 * form.degree
    own = np.ones(inputs)
    own[:3] = form.input_scale
    if layer == 0:
        return own
    hidden = np.full(width - (inputs if layer in network.skips else 0), after)
    return form.skip_factor * np.concatenate((hidden, own)) if layer in network.skips else hidden


def _in_our_order(weight: Float32Array, width: int, form: Form, first: bool) -> Float32Array:
    """[hidden, x, sines axis by axis, cosines axis by axis]; zeros for x where the trainer does not feed it.

    width: columns of the trainer's input.
    """
    hidden = 0 if first else weight.shape[1] - width
    start = 0 if form.input_first else hidden
    own = weight[:, start : start + width]
    rest = np.delete(weight, slice(start, start + width), axis=1) if hidden else weight[:, :0]
    bare = width - 6 * form.degree
    sines = own[:, bare:][:, encoding_order(form.order, form.degree, 6 * form.degree)]
    position = own[:, :3] if bare else np.zeros((len(weight), 3), dtype=np.float32)
    whole = np.concatenate((rest, position, sines), axis=1)
    return np.asarray(whole, dtype=np.float32)


def encoding_order(order: Order, degree: int, width: int) -> npt.NDArray[np.int64]:
    """Where in the trainer's columns of sines and cosines each of ours is."""
    if order == "kind":
        return np.arange(width)
    axis, k = (part.ravel() for part in np.meshgrid(np.arange(3), np.arange(degree), indexing="ij"))
    if order == "frequency":
        sines, step = 6 * k + axis, 3
    elif order == "kind_frequency":
        sines, step = 3 * k + axis, 3 * degree
    else:
        sines, step = 2 * degree * axis + 2 * k, 1
    return np.concatenate((sines, sines + step)).astype(np.int64)


def _times(values: Float32Array, factor: float | npt.NDArray[np.float64]) -> Float32Array:
    if np.all(factor == 1.0):
        return values
    with np.errstate(over="ignore"):  # what is not finite is refused when it is written
        return np.asarray(values * np.asarray(factor, dtype=np.float32), dtype=np.float32)


def skips_of(layers: Layers, names: Sequence[str]) -> tuple[int, ...]:
    """The layers that see the input again. Raises FieldFormatError (TENSOR_SHAPE) where a layer sees anything else."""
    skips = tuple(i for i, extra in enumerate(layers.extra_columns) if extra)
    require_extra_columns(layers, names, dict.fromkeys(skips, layers.input_width))
    return skips


def _invalid(name: str, message: str) -> FieldFormatError:
    return FieldFormatError(f"description.{name}: {message}", reason="INVALID_DESCRIPTION")
