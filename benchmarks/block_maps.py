"""Maps of random worlds as Open3D's VoxelBlockGrid stores them, imported without a word of their truncation.

    python -m benchmarks.block_maps --meshes FOLDER --worlds 40 --report benchmarks/results/block_maps.md

Each world is a furnished room, table or shelf with a sensor, a walk and a drift of its own, fused by Open3D at its
default of 8 voxels and at one other. The distances of the import are held against those of an import that was told.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from benchmarks.random_worlds.models import read_catalog, seeds_of
from benchmarks.random_worlds.walks import KINDS, LENGTHS, make_world
from benchmarks.robust.library_objects import GIVEN
from benchmarks.worlds.recipe import Seen, see
from regnf_core.errors import RegnfError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from regnf_data.fusing import open3d

DEFAULT, OTHERS = 8.0, (4.0, 6.0, 12.0, 16.0)
_EDGE = 16
"""Of a block, in Open3D's examples."""
_IMAGES = 20
_NODES = 20_000


@dataclass(frozen=True)
class Outcome:
    """Of one map. taken: voxels, None where it was refused · far: voxels, the largest distance that the field holds ·
    ratio, off: of the distances, to those of an import that was told: the median ratio, and the median difference in
    voxels · warned: whether a warning says that the truncation was assumed."""

    world: str
    sensor: str
    walk: str
    voxel_mm: float
    fused: float
    taken: float | None
    ratio: float
    off: float
    warned: bool


def outcomes(meshes: list[Path], worlds: int) -> Iterator[Outcome]:
    """Two maps a world."""
    made = 0
    for seed in seeds_of("test"):
        if made == worlds:
            return
        rng = np.random.default_rng([seed, 47])
        world = make_world(seed, read_catalog(meshes, "test", GIVEN), KINDS[seed % len(KINDS)])
        length = LENGTHS[int(rng.choice(3, p=(0.3, 0.5, 0.2)))]
        try:
            seen = see(world, length, rendered=bool(rng.random() < 0.15), again=1)  # a third of the images
        except RegnfError:
            continue
        made += 1
        voxel = float(np.exp(rng.uniform(np.log(0.008), np.log(0.03)))) * (1.0 if world.kind == "room" else 0.6)
        for truncation in (DEFAULT, OTHERS[made % len(OTHERS)]):
            yield _outcome(f"{world.kind} {seed}", seen, voxel, truncation)


def _outcome(name: str, seen: Seen, voxel: float, truncation: float) -> Outcome:
    with tempfile.TemporaryDirectory() as scratch:
        source, told, untold = (Path(scratch) / part for part in ("map.npz", "told", "untold"))
        told.mkdir()
        untold.mkdir()
        nodes = _fuse(seen, voxel, truncation, source)
        true, _ = _imported(source, told, {"truncation": truncation * voxel}, nodes)
        found, report = _imported(source, untold, {}, nodes)
    shared = {"world": name, "sensor": seen.taken.sensor.principle, "walk": seen.name, "voxel_mm": 1000.0 * voxel}
    if report is None or found is None or true is None:
        return Outcome(**shared, fused=truncation, taken=None, ratio=np.nan, off=np.nan, warned=False)
    reach = min(truncation, DEFAULT) * voxel
    known = (np.abs(true) > 0.25 * voxel) & (np.abs(true) < 0.9 * reach)
    return Outcome(
        **shared,
        fused=truncation,
        taken=round(float(np.abs(found).max()) / voxel, 2),
        ratio=float(np.median(np.abs(found / true)[known])),
        off=float(np.median(np.abs(found - true)[known])) / voxel,
        warned=any(warning.startswith("TRUNCATION_ASSUMED") for warning in report["warnings"]),
    )


def _fuse(seen: Seen, voxel: float, truncation: float, path: Path) -> np.ndarray:
    """Write the map as Open3D saves it; (M, 3) nodes of it that were seen."""
    o3d = open3d()
    core, taken = o3d.core, seen.taken
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32,) * 2, (1, 1), voxel, _EDGE, 2_000, core.Device("CPU:0")
    )
    K = core.Tensor(taken.sensor.intrinsics)
    reach = (1.0, float(taken.sensor.farthest_m), truncation)
    for depth, pose in list(zip(taken.depths, taken.estimated, strict=True))[:: max(1, len(taken.poses) // _IMAGES)]:
        if not (depth > 0.0).any():
            continue
        image, camera = o3d.t.geometry.Image(core.Tensor(depth[..., None])), core.Tensor(np.linalg.inv(pose))
        grid.integrate(grid.compute_unique_block_coordinates(image, K, camera, *reach), image, K, camera, *reach)
    grid.save(str(path))
    with np.load(path) as stored:
        block, z, y, x, _ = np.nonzero(stored[f"value_{int(stored['attr_name_weight'].item()):03d}"])
        chosen = np.random.default_rng(0).choice(len(block), min(_NODES, len(block)), replace=False)
        offset = np.stack((x, y, z), axis=1)[chosen]
        return np.asarray(voxel * (_EDGE * stored["key"][block[chosen]] + offset), np.float64)


def _imported(
    source: Path, folder: Path, said: dict[str, Any], nodes: np.ndarray
) -> tuple[np.ndarray | None, dict[str, Any] | None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            report = convert_file(source, folder, {**said, "accept_implausible": True}, ImportLimits())
        except RegnfError as error:
            print(f"{source}: {error.reason} {error}")
            return None, None
        return open_field(folder / FIELD_NAME).signed_distance(torch.from_numpy(nodes)).numpy(), report


def table(found: list[Outcome]) -> str:
    """Markdown: a line for each truncation."""
    lines = [
        "| fused at, voxels | maps | refused | taken at | warned | ratio of distances, median (least to greatest) "
        "| off, voxels, median (greatest) |",
        "|---|---|---|---|---|---|---|",
    ]
    for truncation in sorted({one.fused for one in found}):
        of = [one for one in found if one.fused == truncation]
        sound = [one for one in of if one.taken is not None]
        taken = ", ".join(f"{voxels:g}" for voxels in sorted({one.taken for one in sound if one.taken is not None}))
        ratios, offs = [one.ratio for one in sound], [one.off for one in sound]
        lines.append(
            f"| {truncation:g} | {len(of)} | {len(of) - len(sound)} | {taken} | {sum(one.warned for one in sound)} "
            f"| {median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f}) | {median(offs):.3f} ({max(offs):.3f}) |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, nargs="+", required=True)
    parser.add_argument("--worlds", type=int, default=40)
    parser.add_argument("--report", type=Path)
    given = parser.parse_args()
    found = []
    for outcome in islice(outcomes(given.meshes, given.worlds), 2 * given.worlds):
        found.append(outcome)
        print(json.dumps(outcome.__dict__), flush=True)
    print(table(found))
    if given.report is not None:
        sensors = ", ".join(sorted({one.sensor for one in found}))
        walks = ", ".join(sorted({one.walk for one in found}))
        given.report.write_text(
            f"# Maps of Open3D whose truncation nobody said\n\n{(__doc__ or '').strip()}\n\n"
            f"{given.worlds} worlds of the part test; sensors: {sensors}; walks: {walks}.\n\n{table(found)}\n"
        )


if __name__ == "__main__":
    main()
