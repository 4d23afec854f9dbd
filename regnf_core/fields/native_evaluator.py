"""Evaluation of a neus-facto function by compiled code: hash grid, encoding and network of a block of points at once.

:class:`NeusFactoFunction` has the same function in plain tensor algebra; tests compare the two.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from regnf_core.fields.color_head import PositionalEncoding
from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.native.library import Variant, variant
from regnf_core.native.steps import NativeModel

_CONTRACTIONS = {"none": 0, "linf": 1, "linf_grid": 2}
_COUNTS = ("layers", "levels", "dense_levels", "features", "smoothstep", "directions", "degree", "contraction")
_ARRAYS = ("widths", "weights", "biases", "along", "frequencies", "table", "scales", "strides", "entries", "offsets")


class _Field(ctypes.Structure):
    """regnf_field of field.h, member by member."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in _COUNTS),
        ("radius", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
    )


class NativeEvaluator(NativeModel):
    """A function's present parameters, which are read where they are: it is made for each call."""

    def __init__(self, function: NeusFactoFunction, variant: Variant) -> None:
        """function: one of those that :func:`suits` takes."""
        super().__init__(variant.evaluate, _Described(function))


class _Described:
    """The structure of a function, and what must live as long as it: it holds addresses."""

    def __init__(self, function: NeusFactoFunction) -> None:
        self._field, self._kept = _described(function)
        self.address = ctypes.addressof(self._field)


def suits(function: NeusFactoFunction) -> bool:
    """Whether the compiled code knows this form of network, and the parameters are where and as it reads them.

    Shapes are looked at once more: the code trusts them.
    """
    mlp, encoding, waves = function.mlp, function.hash_encoding, function.positional_encoding
    if mlp.activation != "softplus" or mlp.skip_at is not None or len(mlp.weights) < 2:
        return False
    tensors = [*mlp.weights, *mlp.biases]
    columns = 3 + (0 if waves is None else waves.width)
    if encoding is not None:
        tensors.append(encoding.table)
        columns += encoding.width
    if not all(one.device.type == "cpu" and one.dtype == torch.float32 and one.is_contiguous() for one in tensors):
        return False
    if encoding is not None and len(encoding.table) < encoding.layout.rows:
        return False
    for weight, bias in zip(mlp.weights, mlp.biases, strict=True):
        if weight.shape[1] != columns or bias.shape != weight.shape[:1]:
            return False
        columns = weight.shape[0]
    return columns == 1


def _described(function: NeusFactoFunction) -> tuple[_Field, list[Any]]:
    """The structure, and what must live as long as it: it holds addresses."""
    mlp, encoding, waves = function.mlp, function.hash_encoding, function.positional_encoding
    count = len(mlp.weights)
    widths = (ctypes.c_int32 * (count + 1))(mlp.weights[0].shape[1], *(weight.shape[0] for weight in mlp.weights))
    weights, biases = ((ctypes.c_void_p * count)(*map(Tensor.data_ptr, some)) for some in (mlp.weights, mlp.biases))
    field = _Field(layers=count, contraction=_CONTRACTIONS[function.contraction], radius=function.grid_radius)
    field.widths = ctypes.addressof(widths)
    field.weights, field.biases = ctypes.addressof(weights), ctypes.addressof(biases)
    kept = [function, widths, weights, biases, *mlp.weights, *mlp.biases]
    if waves is not None:
        along, frequencies = _waves(waves)
        field.directions, field.degree = len(along), waves.degree
        field.along, field.frequencies = along.data_ptr(), frequencies.data_ptr()
        kept += [along, frequencies]
    if encoding is not None:
        layout = encoding.layout
        field.levels, field.dense_levels = encoding.active_levels, encoding.dense_levels
        field.features = encoding.config.features_per_level
        field.smoothstep = encoding.config.interpolation == "smoothstep"
        field.table, field.scales = encoding.table.data_ptr(), layout.scales.data_ptr()
        field.strides, field.entries = layout.strides.data_ptr(), layout.entries.data_ptr()
        field.offsets = layout.offsets.data_ptr()
    return field, kept


@lru_cache(maxsize=64)
def _waves(encoding: PositionalEncoding) -> tuple[Tensor, Tensor]:
    """Directions (L, 3) of the lengths that are encoded, and the frequencies."""
    like = torch.empty(0, dtype=torch.float32, device="cpu")
    return encoding.directions(like) if encoding.off_axis else torch.eye(3).to(like), encoding.frequencies(like)


def native_evaluator(function: NeusFactoFunction) -> NativeEvaluator | None:
    """What evaluates the function's present parameters; None where the library is missing, off, or does not suit."""
    found = variant()
    return NativeEvaluator(function, found) if found is not None and suits(function) else None
