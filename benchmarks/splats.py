"""Registration of Gaussian splats: the main pairs as splats, with noise and floaters.

    python -m benchmarks.splats FIELDS [--kind gaussians surfels] [--peer] [--output table.md]

FIELDS as `benchmarks.make_fields` makes them (`--only main`). A scene's splats lie where rays from places in its free
space end, an object's where rays from around it do; they are written as the trainers' PLY files and imported in the
confined process, as an upload is. With --peer splatreg gets the centers of the same splats within the detection box.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import open3d
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import regnf_core as regnf
from benchmarks.peers.interface import PeerCase
from benchmarks.peers.splats import Splatreg
from benchmarks.robust.cases import Case, exact_surface, load_pairs, open_field
from benchmarks.robust.judging import SUCCESSES, judge
from benchmarks.symmetric_errors import errors_against_truth
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.importing.splats.gaussians import Splats, write_ply
from regnf_core.surface.isosurface import extract_surface

Doubles = npt.NDArray[np.float64]
ROOM_SPLATS, OBJECT_SPLATS = 400_000, 80_000
_COVER = 0.5
"""Standard deviation of a splat over the distance to its fourth neighbor: each place is covered by two, about."""
_NOISE, _TILT = 0.001, 0.15
"""Standard deviations of a center along the normal, diagonals, and of the orientation, radians."""
_FLOATERS = 0.05
_PLACES, _AROUND = 60, 60
KINDS = ("gaussians", "surfels")


def scanned(
    vertices: Doubles, faces: npt.NDArray[Any], places: Doubles, count: int, seed: int
) -> tuple[Doubles, Doubles]:
    """Points (N, 3) where rays from places (P, 3) in random directions end, and the normals there."""
    random = np.random.default_rng(seed)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(faces.astype(np.uint32)))
    middle, reach = (vertices.min(axis=0) + vertices.max(axis=0)) / 2, np.ptp(vertices, axis=0) / 2
    points: list[Doubles] = []
    normals: list[Doubles] = []
    while sum(map(len, points)) < count:
        eyes = places[random.integers(len(places), size=4 * count)]
        aims = middle + reach * random.uniform(-1.0, 1.0, (len(eyes), 3))
        rays = aims - eyes
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        answer = scene.cast_rays(open3d.core.Tensor(np.hstack([eyes, rays]).astype(np.float32)), nthreads=1)
        depth, normal = answer["t_hit"].numpy().astype(np.float64), answer["primitive_normals"].numpy()
        hit = np.isfinite(depth)
        points.append(eyes[hit] + depth[hit, None] * rays[hit])
        normals.append(normal[hit] * -np.sign((normal[hit] * rays[hit]).sum(axis=1, keepdims=True)))
    return np.concatenate(points)[:count], np.concatenate(normals)[:count].astype(np.float64)


def as_splats(points: Doubles, normals: Doubles, kind: str, seed: int) -> Splats:
    """Splats on a surface, as trained ones are: sizes by the spacing, thin along the normal, noisy, with floaters."""
    random = np.random.default_rng(seed + 1)
    count, low, high = len(points), points.min(axis=0), points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    spacing = cKDTree(points).query(points, k=5)[0][:, -1]
    wide = _COVER * spacing[:, None] * np.exp(0.4 * random.normal(size=(count, 2)))
    thin = wide.min(axis=1) * random.uniform(0.05, 0.4, count)
    axis = np.cross([0.0, 0.0, 1.0], normals)
    sine, cosine = np.linalg.norm(axis, axis=1), normals[:, 2]
    axis = np.where(sine[:, None] > 1e-9, axis / np.maximum(sine, 1e-9)[:, None], [1.0, 0.0, 0.0])
    base = Rotation.from_rotvec(axis * np.arctan2(sine, cosine)[:, None])
    own = Rotation.from_rotvec(_TILT * random.normal(size=(count, 3))) * base
    own = own * Rotation.from_rotvec(np.column_stack([np.zeros((count, 2)), random.uniform(0, np.pi, count)]))
    places = points + normals * (_NOISE * diagonal * random.normal(size=(count, 1)))
    floating = int(_FLOATERS * count)
    margin = 0.1 * (high - low)
    places = np.concatenate([places, random.uniform(low - margin, high + margin, (floating, 3))])
    sizes = np.concatenate([np.column_stack([wide, thin]), np.median(wide) * random.lognormal(0.0, 0.6, (floating, 3))])
    turns = np.concatenate([own.as_quat(), Rotation.random(floating, rng=random).as_quat()])
    opacities = np.concatenate([random.beta(4.0, 1.5, count), random.uniform(0.05, 0.8, floating)])
    colors = random.uniform(-1.0, 1.0, (len(places), 1, 3)).astype(np.float32)
    scales = np.log(np.maximum(sizes, 1e-9)).astype(np.float32)
    return Splats(
        places, scales, np.roll(turns, 1, axis=1).astype(np.float32), opacities.astype(np.float32), colors,
        flat=kind == "surfels",
    )  # fmt: skip


def room_splats(folder: Path, room: str, kind: str) -> Splats:
    """Of what is seen from places in the free space around the things of the room."""
    vertices, faces = exact_surface(folder, room)
    field = open_field(folder, room)
    boxes = [pair.detection.center.numpy() for pair in load_pairs(folder) if pair.room == room]
    size = max(float(pair.detection.size.max()) for pair in load_pairs(folder) if pair.room == room)
    low, high = np.min(boxes, axis=0) - size, np.max(boxes, axis=0) + size
    low, high = np.maximum(low, field.bounds[0].numpy()), np.minimum(high, field.bounds[1].numpy())
    tried = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    room_ = field.signed_distance(torch.from_numpy(tried).float()).numpy()
    places = tried[np.argsort(-room_)][:2000][:: 2000 // _PLACES]
    points, normals = scanned(vertices.astype(np.float64), faces, places, ROOM_SPLATS, 0)
    return as_splats(points, normals, kind, 0)


def object_splats(folder: Path, name: str, kind: str) -> Splats:
    field = open_field(folder, name)
    mesh = extract_surface(field, 160)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    middle, radius = (vertices.min(axis=0) + vertices.max(axis=0)) / 2, float(np.linalg.norm(np.ptp(vertices, axis=0)))
    away = np.random.default_rng(1).normal(size=(_AROUND, 3))
    places = middle + radius * away / np.linalg.norm(away, axis=1, keepdims=True)
    points, normals = scanned(vertices, faces, places, OBJECT_SPLATS, 2)
    return as_splats(points, normals, kind, 2)


def imported(splats: Splats, path: Path, as_: str) -> tuple[Any, float]:
    """The field, through a PLY file and the confined process, and the seconds of the import."""
    path.write_bytes(write_ply(splats))
    begun = time.perf_counter()
    field = regnf.open_field(path, {"as": as_})
    return field, time.perf_counter() - begun


def by_peer(case: Case, scene: Splats, obj: Splats, diameter: float) -> float:
    """splatreg's MSSD, object diameters."""

    def samples(splats: Splats) -> SurfaceSamples:
        return SurfaceSamples(
            torch.from_numpy(splats.means).float(), torch.from_numpy(splats.axes()[:, :, 2].copy()).float()
        )

    box = case.detection
    local = (torch.from_numpy(scene.means).float() - box.center.float()) @ box.rotation.float()
    inside = (local.abs() <= box.size.float() / 2).all(dim=1).numpy()
    given = PeerCase(
        case.name, case.scene, case.obj, box, case.truth, case.symmetries, diameter,
        samples(scene.chosen(inside)), samples(obj), 0.0, 0,
    )  # fmt: skip
    found = Splatreg("robust", normalized=True).register(given, 0).T_object_scene
    points = given.object_samples.points[::40]
    return (
        float("inf")
        if found is None
        else errors_against_truth(found, case.truth, points, case.symmetries)["mssd_share"]
    )


def rows(folder: Path, kind: str, peer: bool) -> Iterator[dict[str, Any]]:
    rooms: dict[str, tuple[Splats, Any, float]] = {}
    things: dict[str, tuple[Splats, Any, float]] = {}
    scratch = folder / "splats"
    scratch.mkdir(exist_ok=True)
    for pair in load_pairs(folder):
        if pair.room not in rooms:
            splats = room_splats(folder, pair.room, kind)
            rooms[pair.room] = (splats, *imported(splats, scratch / f"{pair.room}-{kind}.ply", "scene"))
        if pair.object not in things:
            splats = object_splats(folder, pair.object, kind)
            things[pair.object] = (splats, *imported(splats, scratch / f"{pair.object}-{kind}.ply", "object"))
        case = pair.case()
        (scene_splats, scene, scene_s), (object_splats_, obj, object_s) = rooms[pair.room], things[pair.object]
        begun = time.perf_counter()
        result = regnf.register(scene, obj, pair.detection)
        row = {"kind": kind, "pair": pair.name, **judge(result, pair.truth, case.symmetries)}
        row |= {"seconds": time.perf_counter() - begun, "import_scene_s": scene_s, "import_object_s": object_s}
        if peer:
            row["splatreg"] = by_peer(case, scene_splats, object_splats_, pair.diameter)
        yield row


def table(found: list[dict[str, Any]]) -> str:
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in found):
        own = [row for row in found if row["kind"] == kind]
        right = sum(row["category"] in SUCCESSES for row in own)
        wrong = sum(row["category"] == "REGISTERED WRONG" for row in own)
        line = f"{kind}: {right} of {len(own)} right and accepted, {wrong} registered wrong"
        if all("splatreg" in row for row in own):
            line += f"; splatreg: {sum(row['splatreg'] <= 0.05 for row in own)} of {len(own)}"
        lines.append(f"{line}.\n")
    peer = any("splatreg" in row for row in found)
    heads = ["kind", "pair", "verdict", "MSSD", *(["splatreg's MSSD"] if peer else [])]
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in found:
        cells = [row["kind"], row["pair"], row["category"], f"{100 * row.get('mssd_share', float('nan')):.2f} %"]
        if "splatreg" in row:
            cells.append(f"{100 * row['splatreg']:.1f} %")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--peer", action="store_true")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    found = []
    for kind in given.kind:
        for row in rows(given.fields, kind, given.peer):
            found.append(row)
            print(json.dumps({key: row[key] for key in row if not key.startswith("seconds_")}), flush=True)
    text = table(found)
    print(text) if given.output is None else given.output.write_text(text)


if __name__ == "__main__":
    main()
