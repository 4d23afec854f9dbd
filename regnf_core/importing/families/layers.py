"""The linear layers of a geometry network, weight normalization folded in, their shapes checked against each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.pickle.pickle_machine import TensorRef
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import shift_rows
from regnf_core.schema.tensor_check import MAX_LAYERS

# What every family does with the uploader's description.

UNIT_CUBE = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
_SHARED = frozenset(
    {
        "family",
        "bounds",
        "world_scale",
        "sign",
        "up_axis",
        "label",
        "frame",
        "dataset_transform",
        "accept_implausible",
        "as",
        "cameras",
        "color",
    }
)
"""Entries that mean something for every family."""


def shared_entries(overrides: UploadDescription, bounds: Sequence[Sequence[float]]) -> dict[str, Any]:
    """The entries of a regnf field file's description that all kinds share.

    bounds: lowest and highest corner in the coordinates of the checkpoint's function. What ``overrides`` says goes
    before.
    """
    scale = overrides.world_scale or 1.0
    return {
        "bounds": overrides.bounds or [[scale * value for value in corner] for corner in bounds],
        "world_scale": scale,
        "sign": overrides.sign or 1,
        "up_axis": overrides.up_axis,
        "label": overrides.label,
    }


def entries_at(entries: dict[str, Any], origin: Sequence[float] | None) -> dict[str, Any]:
    """The shared entries of a function whose coordinates begin at ``origin``, given in the coordinates of the file.

    The field stays in the file's frame: its placement adds the origin again, in float64. None: nothing was subtracted.
    """
    if origin is None:
        return entries
    shift = [entries["world_scale"] * value for value in origin]
    own = [[value - by for value, by in zip(corner, shift, strict=True)] for corner in entries["bounds"]]
    return entries | {"placement": {"transform": shift_rows(shift), "bounds": own}}


def assumed_bounds(overrides: UploadDescription) -> tuple[str, ...]:
    """Why the unit cube bounds a field that trains in the unit sphere; nothing where other bounds are said."""
    return () if overrides.bounds else ("bounds [-1, 1]: the unit sphere's cube, in which it trains",)


def refuse_other_entries(overrides: UploadDescription, family: str, meant: Sequence[str] = ()) -> None:
    """Raise FieldFormatError (INVALID_DESCRIPTION) for an entry that neither all families share nor is ``meant``."""
    others = [name for name, value in overrides.non_default().items() if name not in _SHARED and name not in meant]
    if others:
        raise FieldFormatError(f"description.{others[0]} is not possible for {family}", reason="INVALID_DESCRIPTION")


def require_family(overrides: UploadDescription, family: str) -> None:
    """Raise FieldFormatError (FAMILY_NOT_SUPPORTED) if ``overrides`` names another family than the file's."""
    if overrides.family not in (None, family):
        message = f"the file is {family}, the import options have {overrides.family}"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")


def contradiction(name: str, said: object, found: object) -> FieldFormatError:
    """The error for an entry of the settings or the description that the tensors exclude: both values, by name."""
    message = f"{name}: the config file or the import options have {said}, the tensors have {found}"
    return FieldFormatError(message, reason="SETTINGS_CONTRADICT_TENSORS")


_NORMALIZED = (("weight_v", "weight_g"), ("parametrizations.weight.original1", "parametrizations.weight.original0"))
"""How torch names direction and length of a normalized weight: the older way, the newer way."""


@dataclass(frozen=True)
class Layers:
    """weights[i]: (out_i, in_i), biases[i]: (out_i,). Of the last layer only the first row is kept: the distance."""

    weights: tuple[Float32Array, ...]
    biases: tuple[Float32Array, ...]

    @property
    def input_width(self) -> int:
        """Columns of the first layer."""
        return int(self.weights[0].shape[1])

    @property
    def extra_columns(self) -> tuple[int, ...]:
        """Per layer, how many columns it has beyond the rows of the layer before; 0 for the first."""
        pairs = zip(self.weights, self.weights[1:], strict=False)
        return (0, *(int(after.shape[1] - before.shape[0]) for before, after in pairs))

    def times(self, factor: float) -> Layers:
        """The network whose result is ``factor`` times this one's."""
        last = np.float32(factor)
        return Layers(
            (*self.weights[:-1], np.asarray(last * self.weights[-1], dtype=np.float32)),
            (*self.biases[:-1], np.asarray(last * self.biases[-1], dtype=np.float32)),
        )

    def tensors(self) -> dict[str, Float32Array]:
        """The layers under the names of the regnf field file."""
        named = {f"layers.{i}.weight": weight for i, weight in enumerate(self.weights)}
        return named | {f"layers.{i}.bias": bias for i, bias in enumerate(self.biases)}


def layer_names(state: Mapping[str, Any], prefix: str, minimum: int = 2) -> list[str]:
    """The names ``<prefix>0``, ``<prefix>1`` ... of the layers in ``state``.

    Raises FieldFormatError: TENSOR_MISSING (a gap in the numbers) or FAMILY_NOT_SUPPORTED (fewer than ``minimum``).
    """
    numbers = {key.removeprefix(prefix).split(".")[0] for key in state if key.startswith(prefix)}
    layers = len(numbers)
    if layers > MAX_LAYERS or numbers != {str(i) for i in range(layers)}:
        raise FieldFormatError("the geometry network's layers are not numbered from 0 on", reason="TENSOR_MISSING")
    if layers < minimum:
        raise FieldFormatError(
            f"a geometry network with {layers} layers is not supported", reason="FAMILY_NOT_SUPPORTED"
        )
    return [f"{prefix}{i}" for i in range(layers)]


def read_layers(
    state: Mapping[str, Any],
    names: Sequence[str],
    source: TensorSource,
    has_biases: bool | None = True,
    column: int = 0,
) -> Layers:
    """The layers of these names, in order. has_biases: False where the network has none, which are zero then; None
    where each layer's names tell.

    column: which of the last layer's results is the distance.
    Raises FieldFormatError: TENSOR_MISSING, TENSOR_SHAPE, SETTINGS_CONTRADICT_TENSORS and what TensorSource raises.
    """
    weights, biases = [], []
    for name in names:
        weight = folded_weight(state, name, source)
        bias = np.zeros(weight.shape[0], dtype=np.float32)
        if has_biases or (has_biases is None and f"{name}.bias" in state):
            bias = source.array(f"{name}.bias", lookup(state, f"{name}.bias"))
            require_shape(f"{name}.bias", bias, (weight.shape[0],))
        rows = slice(None)
        if name == names[-1]:
            if column >= len(weight):
                raise contradiction("output_column", column, f"{len(weight)} columns, counted from 0")
            rows = slice(column, column + 1)
        weights.append(weight[rows])
        biases.append(bias[rows])
    return Layers(tuple(weights), tuple(biases))


def require_extra_columns(layers: Layers, names: Sequence[str], allowed: Mapping[int, int] | None = None) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) unless each layer continues the one before, plus ``allowed`` columns."""
    for i, extra in enumerate(layers.extra_columns):
        want = (allowed or {}).get(i, 0)
        if extra != want:
            columns = layers.weights[i].shape[1]
            raise tensor_error(f"{names[i]} has {columns} columns, expected {columns - extra + want}", "TENSOR_SHAPE")


def folded_weight(state: Mapping[str, Any], name: str, source: TensorSource) -> Float32Array:
    """W = g v / |v|, row by row; or the plain weight of a network without weight normalization."""
    if f"{name}.weight" in state:
        weight = source.array(f"{name}.weight", state[f"{name}.weight"])
        require_shape(f"{name}.weight", weight, (None, None))
        return weight
    v, g = next((pair for pair in _NORMALIZED if f"{name}.{pair[0]}" in state), _NORMALIZED[0])
    direction = source.array(f"{name}.{v}", lookup(state, f"{name}.{v}"))
    require_shape(f"{name}.{v}", direction, (None, None))
    length = source.array(f"{name}.{g}", lookup(state, f"{name}.{g}"))
    require_shape(f"{name}.{g}", length, (direction.shape[0], 1))
    norm = np.linalg.norm(direction.astype(np.float64), axis=1, keepdims=True)
    if not norm.all():
        raise FieldFormatError(f"a row of {name}.{v} is zero, so it has no direction", reason="TENSOR_NOT_FINITE")
    return np.asarray(length * (direction / norm), dtype=np.float32)


def strip_prefix(values: object, prefix: str) -> dict[str, Any]:
    """The entries of a state dictionary whose keys begin with ``prefix``, without it; empty where there are none."""
    if not isinstance(values, dict):
        return {}
    named = ((key, value) for key, value in values.items() if isinstance(key, str) and key.startswith(prefix))
    return {key.removeprefix(prefix): value for key, value in named}


def states(checkpoint: dict[Any, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The dictionaries of tensors in a checkpoint, itself included, and where each lies."""
    for where, values in (("", checkpoint), *checkpoint.items()):
        if isinstance(where, str) and isinstance(values, dict):
            named = {key: value for key, value in values.items() if isinstance(key, str)}
            if any(isinstance(value, TensorRef) for value in named.values()):
                yield where, named
