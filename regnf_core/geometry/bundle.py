"""Dataclasses that bundle tensors: what is done to one of them is done to all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, Self

import torch
from torch import Tensor


def over_tensors(operation: Callable[..., Tensor], first: Any, *others: Any) -> Any:
    """What ``operation`` makes of each tensor of ``first`` and those in the same place of ``others``.

    Bundles, tuples and dictionaries are entered; anything else is that of ``first``, which is returned itself where
    nothing has changed.
    """
    if isinstance(first, Tensor):
        return operation(first, *others)
    if isinstance(first, Bundle):
        held = vars(first)
        made = {name: over_tensors(operation, held[name], *(vars(one)[name] for one in others)) for name in held}
        if all(made[name] is held[name] for name in held):
            return first
        changed = copy(first)
        vars(changed).update(made)
        return changed
    if isinstance(first, dict):
        return {name: over_tensors(operation, first[name], *(one[name] for one in others)) for name in first}
    if isinstance(first, tuple):
        return tuple(over_tensors(operation, *parts) for parts in zip(first, *others, strict=True))
    return first


class Bundle:
    """Base of dataclasses with tensors, and with what was computed from them: both move together."""

    def on(self, device: torch.device | str) -> Self:
        """The same on another device; itself where it is there already."""
        found: Self = over_tensors(lambda part: part.to(device), self)
        return found

    def __getitem__(self, index: Any) -> Self:
        """The entries that ``index`` (numbers, bools or a slice) names along the first axis of all tensors."""
        found: Self = over_tensors(lambda part: part[index], self)
        return found

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """All entries of several bundles, one after the other; what is no tensor is that of the first."""
        found: Self = over_tensors(lambda *tensors: torch.cat(tensors), *parts)
        return found


class CopiedOnce:
    """Tensors for work on any device: copied to each where they are requested, once."""

    def __init__(self, *parts: Tensor) -> None:
        self._there = {parts[0].device: parts}

    def on(self, device: torch.device) -> tuple[Tensor, ...]:
        if device not in self._there:
            self._there[device] = tuple(part.to(device) for part in next(iter(self._there.values())))
        return self._there[device]
