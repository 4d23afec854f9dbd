"""Where the input comes in once more: by the settings, and by the tensors' shapes."""

from __future__ import annotations

import itertools

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said


def agree_on_skips(keys: Keys, key: str, prefix: str, said: Said) -> None:
    """Raise FieldFormatError (SETTINGS_CONTRADICT_TENSORS) if the layers of ``prefix`` see the input at others than
    ``key`` names. Layers that the network has not are left out, as their trainers do.
    """
    named = keys.wholes(key)
    shapes = [_weight(said, f"{prefix}{i}") for i in range(said.facts.count(prefix, ".bias"))]
    if named is None or len(shapes) < 2 or not all(shapes):
        return
    pairs = [(before, after) for before, after in itertools.pairwise(shapes) if before and after]
    found = [i + 1 for i, (before, after) in enumerate(pairs) if before[0] != after[1]]
    expected = sorted({i for i in named if 0 < i < len(shapes)})
    if found != expected:
        raise contradiction(f"{keys.file}: {keys.at}{key}", expected, found)
    said.note(keys, key)


def _weight(said: Said, layer: str) -> tuple[int, ...] | None:
    shape = said.facts.shape(f"{layer}.weight_v") or said.facts.shape(f"{layer}.weight")
    return shape if shape is not None and len(shape) == 2 else None
