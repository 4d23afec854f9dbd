"""How well fields fitted to posed RGB-D images follow the surfaces that were seen, and what a fit costs.

    python -m benchmarks.fit_images MESHES ROOMS IMAGES FIELDS [--names NAME ...] [--output RESULT.md]

IMAGES is the folder of benchmarks.make_image_datasets, MESHES and ROOMS what it was rendered from. FIELDS gets a field
and a .fit.json a dataset; what exists there is kept and measured. Seen is what a camera's exact ray meets first. From
the field: points of its zero level near seen points, to the true scene. To the field: seen points, to its zero level.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from os import cpu_count
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from benchmarks.fit_pieces import Floats, Piece, distances_to, measure_pieces, moved
from benchmarks.make_image_fields import OBJECT_OPTIONS, ROOM_OPTIONS
from benchmarks.worlds.composing import room_scene
from benchmarks.worlds.layouts import read_layout
from benchmarks.worlds.mesh_scene import MeshScene, load_thing
from benchmarks.worlds.rendering import camera_rays
from regnf_core.fields.build import open_field
from regnf_core.surface.isosurface import extract_surface
from regnf_data.posed_images import PosedImages
from regnf_data.sdfstudio import load_dataset
from regnf_fit.images.fit import FitFiles, reconstruct

_POINTS = 30_000
_RESOLUTION = 256
_NEAR_SEEN_M = 0.03
_NEAR_SEEN_SHARE = 0.01


@dataclass(frozen=True)
class Figures:
    """Lengths in millimeters. errors: of the field's surface where it was seen, of the seen surface to the field's, and
    of the depths that it was fitted to."""

    diameter: float
    from_field: float
    from_field_p95: float
    to_field: float
    to_field_p95: float
    depths: float
    free_distance: float
    """Mean error of the distance at points that were seen to be free."""
    false_matter: float
    """The share of those that the field takes for matter."""
    pieces: tuple[Piece, ...]
    """One an instance of a room; none of an object's images."""


def measure(images: PosedImages, scene: MeshScene, path: Path) -> Figures:
    """Of the field in ``path``; the scene is metric."""
    assert images.T_metric_world is not None
    rng = np.random.default_rng(0)
    T = images.T_metric_world
    T_world_metric: Floats = np.linalg.inv(T).astype(np.float64)
    millimeters = 1000.0 * float(np.cbrt(np.linalg.det(T[:3, :3])))
    field = open_field(path)
    seen, free, read = _seen(images, scene, rng)
    near = min(_NEAR_SEEN_M, _NEAR_SEEN_SHARE * float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])))
    surface = extract_surface(field, _RESOLUTION)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    sampled = moved(trimesh.sample.sample_surface(mesh, 4 * _POINTS, seed=0)[0], T)
    beside = sampled[cKDTree(seen).query(sampled)[0] < near][:_POINTS]
    chosen = seen[rng.permutation(len(seen))[:_POINTS]]
    out = 1000.0 * np.abs(scene.signed_distance(beside))
    back = millimeters * distances_to(mesh, moved(chosen, T_world_metric))
    distance = field.signed_distance(torch.from_numpy(moved(free, T_world_metric)).float()).numpy()
    return Figures(
        diameter=1000.0 * float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])),
        from_field=_mean(out),
        from_field_p95=_p95(out),
        to_field=_mean(back),
        to_field_p95=_p95(back),
        depths=float(1000.0 * np.abs(scene.signed_distance(read)).mean()),
        free_distance=float(np.abs(millimeters * distance - 1000.0 * scene.signed_distance(free)).mean()),
        false_matter=float((distance < 0.0).mean()),
        pieces=measure_pieces(images, scene, field, seen) if len(scene.things) > 1 else (),
    )


def _mean(values: Floats) -> float:
    """nan where the field has no surface near what was seen."""
    return float(values.mean()) if len(values) else math.nan


def _p95(values: Floats) -> float:
    return float(np.quantile(values, 0.95)) if len(values) else math.nan


def _seen(images: PosedImages, scene: MeshScene, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Metric points within the bounds: where exact rays end, anywhere before that, and where measured depths end."""
    assert images.T_metric_world is not None
    assert images.depths is not None
    ends, free, read = [], [], []
    for depth, camera, pose in zip(images.depths, images.intrinsics, images.T_world_camera, strict=True):
        origins, directions = camera_rays(images.size, camera, images.T_metric_world @ pose)
        hit = scene.cast(origins, directions).distance
        met = np.isfinite(hit)
        origins, directions, hit = origins[met], directions[met], hit[met]
        ends.append(origins + hit[:, None] * directions)
        free.append(origins + (rng.random(len(hit)) * hit)[:, None] * directions)
        measured = depth.reshape(-1)[met].astype(np.float64)
        read.append((origins + measured[:, None] * directions)[measured > 0.0])
    low, high = moved(images.bounds, images.T_metric_world)
    kept = []
    for points in (np.concatenate(ends), np.concatenate(free), np.concatenate(read)):
        inside = points[((points > low) & (points < high)).all(axis=1)]
        kept.append(inside[rng.permutation(len(inside))[: 20 * _POINTS]])
    return kept[0], kept[1][:_POINTS], kept[2][:_POINTS]


def scene_of(entry: dict[str, Any], meshes: Path, rooms: Path) -> MeshScene:
    """What a dataset in the manifest was rendered from, metric."""
    first = entry["inputs"][0]
    if first.endswith(".json"):
        return room_scene(read_layout(rooms / first, meshes))
    return MeshScene([load_thing(meshes / first)])


def fitted(name: str, kind: str, images: PosedImages, fields: Path) -> dict[str, Any]:
    """The report of the fit in ``fields``, which is made if it is not there."""
    path, told = fields / f"{name}.safetensors", fields / f"{name}.fit.json"
    if not path.exists():
        options = OBJECT_OPTIONS if kind == "objects" else ROOM_OPTIONS
        report = reconstruct(images, FitFiles(path), options, device="cpu", label=name)
        told.write_text(json.dumps(asdict(report), indent=1) + "\n")
    return dict(json.loads(told.read_text()))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("meshes", "rooms", "images", "fields"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--names", nargs="+", default=None, help="datasets; else all objects and long walks")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/fit_images.md"))
    given = parser.parse_args(arguments)
    manifest = json.loads((given.images / "manifest.json").read_text())
    usual = [name for name, entry in manifest.items() if entry["kind"] == "objects" or name.endswith("-long")]
    rows = []
    for name in given.names or usual:
        images = load_dataset(given.images / name)
        report = fitted(name, manifest[name]["kind"], images, given.fields)
        figures = measure(
            images, scene_of(manifest[name], given.meshes, given.rooms), given.fields / f"{name}.safetensors"
        )
        rows.append((name, len(images), report, figures))
        print(name, report["seconds"], figures, flush=True)
    given.output.write_text(_table(rows))


def _table(rows: list[tuple[str, int, dict[str, Any], Figures]]) -> str:
    threads = torch.get_num_threads()
    lines = [
        "# Fields fitted to posed RGB-D images",
        "",
        f"Command: `python -m benchmarks.fit_images MESHES ROOMS IMAGES FIELDS`, {datetime.now(UTC):%Y-%m-%d}, "
        f"{platform.system()} {platform.machine()}, {threads} of {cpu_count()} cores,",
        f"Python {platform.python_version()}",
        "",
        "Errors in millimeters, mean and 95th percentile, where the surface was seen; of objects in per cent of the",
        "diameter too. Depths: mean error of the depths fitted to. Free: mean error of the distance at points seen to",
        "be free, and the share of them that the field takes for matter. PSNR: on held-out pixels.",
        "",
        "| | images | seconds | from the field | to the field | depths | free | false matter | PSNR |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, count, report, f in rows:
        share = f" = {100.0 * f.from_field / f.diameter:.2f} %" if f.diameter < 4000.0 else ""
        back = f" = {100.0 * f.to_field / f.diameter:.2f} %" if share else ""
        psnr = "none" if report["psnr"] is None else f"{report['psnr']:.1f}"
        lines.append(
            f"| {name} | {count} | {report['seconds']:.0f} | {f.from_field:.1f} ({f.from_field_p95:.1f}){share} "
            f"| {f.to_field:.1f} ({f.to_field_p95:.1f}){back} | {f.depths:.1f} | {f.free_distance:.1f} "
            f"| {100.0 * f.false_matter:.2f} % | {psnr} |"
        )
    return "\n".join([*lines, *_piece_lines({name: f.pieces for name, _, _, f in rows if f.pieces})]) + "\n"


def _piece_lines(rooms: dict[str, tuple[Piece, ...]]) -> list[str]:
    if not rooms:
        return []
    lines = [
        "",
        "Of the furniture alone, in millimeters. Beyond: the share of the field's surface more than 5 cm from the true",
        "scene, left out of the mean. Missing: the share of the seen surface more than 5 cm from the field's.",
        "",
        "| room | piece | from the field | to the field | beyond | missing |",
        "|---|---|---|---|---|---|",
    ]
    for room, pieces in rooms.items():
        lines += [
            f"| {room} | {p.label} | {p.from_field:.1f} | {p.to_field:.1f} | {100.0 * p.beyond:.1f} % "
            f"| {100.0 * p.missing:.1f} % |"
            for p in pieces
        ]
    return lines


if __name__ == "__main__":
    main()
