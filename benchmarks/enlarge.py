"""Full-size fields that equal small ones: for timing what a field's size alone costs.

    python -m benchmarks.enlarge FIELDS

Writes the mix room and its armchair with 16 levels of up to 2^19 entries and layers of 256 (pairs-full-size.json lists
them). The added levels and neurons hold zeros; a level that was hashed before is written out where it now has room.
Every entry is read and every product taken as in any other field of that size; the values are those of the small field.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description, write_safe_field

LEVELS, LOG2_SIZE, WIDTH = 16, 19, 256
SUFFIX = "-full-size"
_PRIMES = (np.uint32(1), np.uint32(2654435761), np.uint32(805459861))
Table = NDArray[np.float32]


def enlarge(source: Path, target: Path) -> None:
    """Write the field of ``source``, a neus-facto field of two hidden layers, at full size."""
    description, tensors = read_description(source), load_file(source)
    small = HashGridConfig(**description["hash"])
    large = replace(small, levels=LEVELS, log2_table_size=LOG2_SIZE)
    columns = 3 + 6 * description["positional_encoding"]["degree"]
    first, second, last = (tensors[f"layers.{i}.weight"] for i in range(3))
    hidden, seen = first.shape
    wide_first = np.zeros((WIDTH, columns + large.width), np.float32)
    wide_first[:hidden, :seen] = first
    wide_second = np.zeros((WIDTH, WIDTH), np.float32)
    wide_second[:hidden, :hidden] = second
    wide_last = np.zeros((1, WIDTH), np.float32)
    wide_last[:, :hidden] = last
    write_safe_field(
        target,
        {**description, "hash": asdict(large)},
        {
            "hash_table": enlarged_table(tensors["hash_table"], small, large),
            "layers.0.weight": wide_first,
            "layers.1.weight": wide_second,
            "layers.2.weight": wide_last,
            "layers.0.bias": np.pad(tensors["layers.0.bias"], (0, WIDTH - hidden)),
            "layers.1.bias": np.pad(tensors["layers.1.bias"], (0, WIDTH - hidden)),
            "layers.2.bias": tensors["layers.2.bias"],
        },
    )


def enlarged_table(table: Table, small: HashGridConfig, large: HashGridConfig) -> Table:
    """The small grid's table (E, F) laid out as the large grid asks; entries of levels it did not have are zero."""
    parts = []
    start = 0
    for level, entries in enumerate(large.level_entries()):
        part = np.zeros((entries, table.shape[1]), np.float32)
        if level < small.levels:
            count = small.level_entries()[level]
            old = table[start : start + count]
            start += count
            if small.level_is_dense()[level]:
                part[:count] = old
            elif large.level_is_dense()[level]:
                stride = large.level_strides()[level]
                part[: stride**3] = old[hashed(stride) % count]
            else:
                part[:] = np.tile(old, (entries // count, 1))  # the hash's lower bits say where it lay before
        parts.append(part)
    return np.concatenate(parts)


def hashed(nodes: int) -> NDArray[np.uint32]:
    """The hashes of all nodes of a cubic grid, x fastest."""
    z, y, x = np.meshgrid(*[np.arange(nodes, dtype=np.uint32)] * 3, indexing="ij")
    return ((x * _PRIMES[0]) ^ (y * _PRIMES[1]) ^ (z * _PRIMES[2])).reshape(-1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    folder = parser.parse_args().fields
    pairs = [one for one in json.loads((folder / "pairs.json").read_text()) if one["room"] == "mix-room"]
    pairs = [one for one in pairs if one["instance"] == "fc"]
    for one in pairs:
        for key in ("room", "object"):
            enlarge(folder / f"{one[key]}.safetensors", folder / f"{one[key]}{SUFFIX}.safetensors")
            one[key] += SUFFIX
    (folder / "pairs-full-size.json").write_text(json.dumps(pairs, indent=1) + "\n")


if __name__ == "__main__":
    main()
