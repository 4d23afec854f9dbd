"""Where in a checkpoint the state dictionary of a network lies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from regnf_core.importing.families.layers import strip_prefix
from regnf_core.importing.pickle.pickle_values import TensorRef

_WRAPPERS = ("", "module.", "model.", "module.model.", "model.module.", "_orig_mod.", "net.", "network.")
"""What trainers put before the names of a network's own parts."""


def states(checkpoint: dict[Any, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The dictionaries of tensors in a checkpoint, itself included, and where each lies."""
    for where, values in (("", checkpoint), *checkpoint.items()):
        if isinstance(where, str) and isinstance(values, dict):
            named = {key: value for key, value in values.items() if isinstance(key, str)}
            if any(isinstance(value, TensorRef) for value in named.values()):
                yield where, named


def state_under(checkpoint: dict[Any, Any], part: str) -> dict[str, Any]:
    """The tensors of the network's part ``part`` (a prefix that ends in a dot), without it; empty where none is."""
    for _, state in states(checkpoint):
        for wrapper in _WRAPPERS:
            found = strip_prefix(state, wrapper + part)
            if found:
                return found
    return {}
