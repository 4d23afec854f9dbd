"""Co-SLAM: config.json of a run, the scene's file and those that it inherits from in one."""

from __future__ import annotations

import numpy as np

from regnf_core.importing.settings.documents import Documents, mappings
from regnf_core.importing.settings.facts import scaled_and_moved
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.said import Said
from regnf_core.schema.hash_grid_config import HashGridConfig

_BASE = 16
_LEAST_NODES = 10
"""A ``voxel_sdf`` above this is no length but the resolution."""


def main_file(documents: Documents) -> Keys | None:
    """The file that is one of theirs."""
    return next(
        (keys for keys in mappings(documents) if keys.has("mapping.bound") and keys.has("training.trunc")), None
    )


def translate(keys: Keys, said: Said) -> None:
    """Fill ``said``. Raises FieldFormatError: SETTINGS_MALFORMED, SETTINGS_CONTRADICT_TENSORS, FAMILY_NOT_SUPPORTED."""
    said.put("family", "co_slam", keys, "mapping.bound")
    for path, only in (("grid.enc", "hashgrid"), ("pos.enc", "oneblob")):
        if (keys.text(path) or only).lower() != only:
            said.refuse(keys, path)
    if keys.flag("grid.tcnn_encoding") is False:
        said.refuse(keys, "grid.tcnn_encoding")
    box = _corners(keys, "mapping.bound")
    said.put("grid_box", box, keys, "mapping.bound")
    if keys.has("mapping.marching_cubes_bound"):
        said.put("bounds", _corners(keys, "mapping.marching_cubes_bound"), keys, "mapping.marching_cubes_bound")
    factor, shift = keys.number("data.sc_factor"), keys.number("data.translation") or 0.0
    factor = 1.0 if factor is None else factor
    if not factor > 0:
        raise keys.fault("data.sc_factor", "a positive number")
    truncation = keys.number("training.trunc")
    said.put("truncation", None if truncation is None else truncation * factor, keys, "training.trunc")
    said.values["dataset_transform"] = scaled_and_moved(1.0 / factor, [-shift] * 3)
    said.put("hash.log2_table_size", keys.whole("grid.hash_size"), keys, "grid.hash_size")
    said.put("hash.top_resolution", _resolution(keys, said, box), keys, "grid.voxel_sdf")
    first = said.facts.shape("decoder.sdf_net.model.0.weight")
    said.agree(keys, "decoder.hidden_dim", first[0] if first else None)
    said.agree(keys, "decoder.num_layers", said.facts.count("decoder.sdf_net.model.", ".weight") or None)
    said.agree(keys, "pos.n_bins", (first[1] - 32) // 3 if first else None)


def _corners(keys: Keys, path: str) -> list[list[float]]:
    """From lowest and highest per axis."""
    rows = keys.matrix(path, 3, 2) or []
    return [[row[0] for row in rows], [row[1] for row in rows]]


def _resolution(keys: Keys, said: Said, box: list[list[float]]) -> int | None:
    """The finest resolution: the box's longest edge in voxels, cut to a whole number, in single precision.

    Where the quotient is whole, another device's rounding may have cut it to one less: the table's size tells.
    """
    voxel = keys.number("grid.voxel_sdf")
    if voxel is None or voxel > _LEAST_NODES:
        return keys.whole("grid.voxel_sdf")
    if not voxel > 0:
        raise keys.fault("grid.voxel_sdf", "a positive number")
    low, high = np.array(box, dtype=np.float32)
    with np.errstate(over="ignore"):
        cells = float((high - low).max() * (np.float32(1.0) / np.float32(voxel)))
    if not _BASE < cells < 1 << 20:
        raise keys.fault("grid.voxel_sdf", f"a voxel of which {_BASE} to 2^20 make the box's longest edge")
    others = [n for n in (round(cells) - 1, round(cells)) if abs(cells - round(cells)) < 1e-3 and n > _BASE]
    usual, rows = int(cells), _rows(said)
    return next((n for n in (usual, *others) if rows is not None and _entries(keys, n) == rows), usual)


def _rows(said: Said) -> int | None:
    shape = said.facts.shape("embed_fn.params")
    return shape[0] // 2 if shape else None


def _entries(keys: Keys, top: int) -> int | None:
    log2_size = keys.whole("grid.hash_size")
    if log2_size is None or not 3 <= log2_size <= 24:
        return None
    return HashGridConfig.from_top_resolution(top, log2_table_size=log2_size, base_resolution=_BASE).entries
