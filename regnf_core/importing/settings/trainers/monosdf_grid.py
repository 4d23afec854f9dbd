"""MonoSDF's hash grid: keys of ``model.implicit_network``. What its files leave out has the trainer's default."""

from __future__ import annotations

import itertools
import math

from regnf_core.importing.families.layers import contradiction
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said

_LAYOUT = {
    "num_levels": ("levels", 16),
    "level_dim": ("features_per_level", 2),
    "logmap": ("log2_table_size", 19),
    "base_size": ("base_resolution", 16),
    "end_size": ("top_resolution", 2048),
}
"""Each key, the entry of ``hash`` that it is, and the trainer's default."""
_DIVISOR = 1.5
"""The default of ``divide_factor``."""
_ROUNDING = 0.02
"""Where a resolution is whole, rounding may give a level one node more along an edge."""


def grid_of_monosdf(network: Keys, said: Said) -> None:
    """Fill ``said`` by the keys of ``network``. Raises FieldFormatError: SETTINGS_MALFORMED,
    SETTINGS_CONTRADICT_TENSORS.
    """
    used = network.flag("use_grid_feature")
    if said.facts.tensors and not said.facts.count("implicit_network.encoding.", ".embeddings"):
        if used:
            raise contradiction(f"{network.file}: {network.at}use_grid_feature", True, "no table of a grid")
        return
    said.put("use_grid", used, network, "use_grid_feature")
    given = {key: network.whole(key) for key in _LAYOUT}
    complete = {key: default if given[key] is None else given[key] for key, (_, default) in _LAYOUT.items()}
    by_default = _gives_the_table(complete, said)
    for key, (entry, _) in _LAYOUT.items():
        if given[key] is not None:
            said.put(f"hash.{entry}", given[key], network, key)
        elif by_default:
            said.values[f"hash.{entry}"] = complete[key]
    divisor = network.number("divide_factor")
    if divisor is not None and divisor <= 0:
        raise network.fault("divide_factor", "a positive number")
    said.put("hash.radius", divisor, network, "divide_factor")
    if divisor is None:
        said.values["hash.radius"] = _DIVISOR


def _gives_the_table(layout: dict[str, int | None], said: Said) -> bool:
    """Whether the table has as many rows as such a grid, in which case what is not said is the trainer's default.

    Rows are counted as they are, or each level in whole eights.
    """
    shape = said.facts.shape("implicit_network.encoding.embeddings")
    levels, features, log2_size, base, top = (layout[key] or 0 for key in _LAYOUT)
    if shape is None or len(shape) != 2 or shape[1] != features or not 1 < levels <= 32:
        return False
    if not 1 <= log2_size <= 24 or not 1 < base <= top <= 1 << 20:
        return False
    growth = 2.0 ** (math.log2(top / base) / (levels - 1))
    rows = [0, 0]
    for level, eights in itertools.product(range(levels), (False, True)):
        nodes = (math.ceil(base * growth**level) + 1) ** 3
        rows[eights] += min(1 << log2_size, -(-nodes // 8) * 8 if eights else nodes)
    return any(abs(count - shape[0]) <= _ROUNDING * count for count in rows)
