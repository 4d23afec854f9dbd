"""Clouds without usable normals: of how many points the estimated normal has the right side.

    python -m benchmarks.clouds MESHES [--start 1] [--every 2] [--output table.md]

Each mesh of the folder is measured by a simulated scanner from 24 places around it, with noise. The cloud is given
without normals, with normals whose signs are drawn at random, and with normals in another order. A point counts where
no surface that faces the other way is within 2.5 point spacings: below that the points do not tell the side.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

from regnf_core.importing.families.cloud import oriented_cloud
from regnf_core.importing.upload_description import UploadDescription

Array = npt.NDArray[np.float64]
_VIEWS, _RAYS, _AWAY, _HALF_WIDTH = 24, 120, 1.6, 0.4
_NOISE = 0.001
"""Diagonals of the mesh: standard deviation along the ray."""
_POINTS = 15_000
_THICK = 2.5
_RIGHT = 0.95
"""A cloud is right if so many of the points that count have the right side."""
_LEAST = 0.2
"""Share of the points that must count, for a mesh to count."""
WAYS = ("without normals", "signs at random", "another order")


def scanned(mesh: trimesh.Trimesh, random: np.random.Generator) -> tuple[Array, Array]:
    """Points (N, 3) and the true normals (N, 3) towards the scanner; the points' diagonal is 1."""
    import open3d

    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    vertices = (vertices - vertices.mean(axis=0)) / np.linalg.norm(np.ptp(vertices, axis=0))
    scene = open3d.t.geometry.RaycastingScene()
    faces = open3d.core.Tensor(mesh.faces.astype(np.uint32))
    scene.add_triangles(open3d.core.Tensor(vertices.astype(np.float32)), faces)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    points, normals = [], []
    for away in _directions():
        eye, rays = middle + _AWAY * away, _image(-away)
        cast = np.hstack([np.broadcast_to(eye, rays.shape), rays]).astype(np.float32)
        answer = scene.cast_rays(open3d.core.Tensor(cast), nthreads=1)
        depth, normal = answer["t_hit"].numpy().astype(np.float64), answer["primitive_normals"].numpy()
        hit = np.isfinite(depth)
        depth = depth + _NOISE * random.normal(size=len(depth))
        points.append(eye + depth[hit, None] * rays[hit])
        normals.append(normal[hit] * -np.sign((normal[hit] * rays[hit]).sum(axis=1, keepdims=True)))
    cloud, sides = np.concatenate(points), np.concatenate(normals).astype(np.float64)
    chosen = random.permutation(len(cloud))[:_POINTS]
    cloud = (cloud - cloud.min(axis=0)) / np.linalg.norm(np.ptp(cloud, axis=0))
    return cloud[chosen], sides[chosen]


def _directions() -> Iterator[Array]:
    """Spread evenly over the sphere, by the golden angle."""
    for number in range(_VIEWS):
        height, turn = 1.0 - (2.0 * number + 1.0) / _VIEWS, np.pi * (1.0 + 5.0**0.5) * number
        ring = np.sqrt(1.0 - height**2)
        yield np.array([ring * np.cos(turn), ring * np.sin(turn), height])


def _image(ahead: Array) -> Array:
    """(R, 3) rays of length one of a square image around a direction."""
    beside = np.cross(ahead, [0.0, 0.0, 1.0] if abs(ahead[2]) < 0.9 else [1.0, 0.0, 0.0])
    beside /= np.linalg.norm(beside)
    steps = np.linspace(-_HALF_WIDTH, _HALF_WIDTH, _RAYS)
    x, y = np.meshgrid(steps, steps)
    rays = ahead + x[..., None] * beside + y[..., None] * np.cross(beside, ahead)
    found: Array = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    return found


def that_count(points: Array, normals: Array) -> npt.NDArray[np.bool_]:
    """(N,): points that have no neighbor which faces the other way."""
    apart, near = cKDTree(points).query(points, k=25)
    spacing = float(np.median(apart[:, 6])) / 1.38
    opposite = (normals[near] * normals[:, None]).sum(axis=2) < -0.5
    counts: npt.NDArray[np.bool_] = ~(opposite & (apart < _THICK * spacing)).any(axis=1)
    return counts


def shares(points: Array, normals: Array, random: np.random.Generator) -> tuple[list[float], float]:
    """Of the points that count, the share with the right side for each of WAYS, and the share that counts."""
    counts = that_count(points, normals)
    given = (None, normals * random.choice([-1.0, 1.0], (len(normals), 1)), random.permutation(normals))
    found = [oriented_cloud(points, one, None, UploadDescription())[0].normals for one in given]
    return [float(((one * normals).sum(axis=1) > 0.0)[counts].mean()) for one in found], float(counts.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--start", type=int, default=1, help="number of the first mesh, by name")
    parser.add_argument("--every", type=int, default=2, help="so many meshes on is the next one")
    parser.add_argument("--most", type=int, default=40)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    lines, rows = [], []
    for number, path in enumerate(sorted(given.meshes.glob("*.glb"))[given.start :: given.every][: given.most]):
        random = np.random.default_rng(number)
        points, normals = scanned(trimesh.load(path, force="mesh"), random)
        found, counting = shares(points, normals, random)
        lines.append(f"| {path.stem} | {counting:.2f} | {' | '.join(f'{one:.3f}' for one in found)} |")
        print(lines[-1], flush=True)
        if counting >= _LEAST:
            rows.append(found)
    right = [sum(row[way] >= _RIGHT for row in rows) for way in range(len(WAYS))]
    inside_out = [sum(row[way] < 0.5 for row in rows) for way in range(len(WAYS))]
    told = ", ".join(f"{name}: {one} of {len(rows)}" for name, one in zip(WAYS, right, strict=True))
    head = ["| mesh | share that counts | " + " | ".join(WAYS) + " |", "|---|---|---|---|---|"]
    text = [f"Right, at least {_RIGHT} of the points that count: {told}. Inside out: {sum(inside_out)}.", "", *head]
    whole = "\n".join([*text, *lines]) + "\n"
    print(whole) if given.output is None else given.output.write_text(whole)


if __name__ == "__main__":
    main()
