"""Chains of linear layers in a state dictionary: each sees what the one before gives, perhaps with the input again."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from regnf_core.importing.pickle.pickle_values import TensorRef
from regnf_core.schema.layers import MAX_LAYERS

_ENDINGS = (".weight", ".weight_v", ".parametrizations.weight.original1")
_PARTS = (".weight", ".bias", ".weight_v", ".weight_g", ".parametrizations.weight.original0", _ENDINGS[2])
_DEPTH = 4
_DISTANCE_WORDS = ("sdf", "implicit", "geometry", "surface", "dist")


@dataclass(frozen=True)
class Chain:
    """Layers by name, in order; those in ``skips`` see the network's input again."""

    where: str
    names: tuple[str, ...]
    input_width: int
    skips: tuple[int, ...]


def find_chains(state: dict[str, Any]) -> list[Chain]:
    """The networks of a state dictionary that are chains of at least two linear layers and nothing else.

    All of it together, or its largest parts, by the components of their names; where several are found and the names
    of some say that they are distances, those.
    """
    for depth in range(_DEPTH):
        groups: dict[str, dict[str, Any]] = {}
        for name, value in state.items():
            groups.setdefault(".".join(name.split(".")[:depth]), {})[name] = value
        chains = [chain for where, group in groups.items() if (chain := _chain(where, group)) is not None]
        if chains:
            named = [chain for chain in chains if any(word in chain.where.lower() for word in _DISTANCE_WORDS)]
            return named or chains
    return []


def _chain(where: str, group: dict[str, Any]) -> Chain | None:
    layers = _linear_layers(group)
    if layers is None or not 2 <= len(layers) <= MAX_LAYERS:
        return None
    inputs, skips = layers[0][1][1], []
    for i, (before, after) in enumerate(itertools.pairwise(layers), start=1):
        extra = after[1][1] - before[1][0]
        if extra not in (0, inputs):
            return None
        if extra:
            skips.append(i)
    return Chain(where, tuple(name for name, _ in layers), inputs, tuple(skips))


def _linear_layers(group: dict[str, Any]) -> Sequence[tuple[str, tuple[int, ...]]] | None:
    """Names and shapes (out, in); None where the group holds tensors of anything else."""
    tensors = {name: value.shape for name, value in group.items() if isinstance(value, TensorRef)}
    layers = []
    for name, shape in tensors.items():
        ending = next((e for e in _ENDINGS if name.endswith(e)), None)
        if ending is not None and len(shape) == 2 and min(shape) > 0:
            layers.append((name.removesuffix(ending), shape))
    known = {name + part for name, _ in layers for part in _PARTS}
    return layers if layers and set(tensors) <= known else None
