"""Make the depth image of the examples: a statue of a cat on a table, beside a kettle and a vase, with a known pose.

    python scripts/make_demo_frame.py MESHES [--out examples/data/frame]

MESHES holds the glb files `concrete_cat_statue`, `vintage_electric_kettle` and `ceramic_vase_01` of Poly Haven (CC0).
It writes what a depth camera gives (depth.png in millimeters with a sensor's noise, color.png, camera.json), what a
detector gives (mask.png, mask.json), the model as people have it (cat.stl, millimeters) and truth.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from benchmarks.worlds.mesh_scene import MeshScene, box_thing, load_thing, tile_paint
from benchmarks.worlds.rendering import DepthSensor, render
from benchmarks.worlds.trajectories import look_at

_SIZE = 480, 640
_K = np.array([[605.0, 0.0, 320.0], [0.0, 605.0, 240.0], [0.0, 0.0, 1.0]])
_PLACES = {
    "concrete_cat_statue": (25.0, (0.0, 0.0)),
    "vintage_electric_kettle": (130.0, (-0.26, 0.2)),
    "ceramic_vase_01": (0.0, (0.2, 0.22)),
}
"""Degrees about z, and where on the table, m."""
_EYE, _TARGET = np.array([[0.35, -0.85, 0.62]]), np.array([[0.0, 0.03, 0.1]])
_SEED = 4


def pose_on_table(degrees: float, place: tuple[float, float]) -> NDArray[np.float64]:
    T = np.eye(4)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], place
    return T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("--out", type=Path, default=Path("examples/data/frame"))
    given = parser.parse_args()
    poses = {name: pose_on_table(*place) for name, place in _PLACES.items()}
    things = [load_thing(given.meshes / f"{name}.glb", T, name) for name, T in poses.items()]
    scene = MeshScene(
        [
            *things,
            box_thing([-0.7, -0.5, -0.04], [0.7, 0.6, 0.0], tile_paint((0.32, 0.22, 0.13), (0.34, 0.235, 0.14), 0.2)),
            box_thing([-3.0, -3.0, -0.8], [3.0, 3.0, -0.76], tile_paint((0.3, 0.3, 0.31), (0.28, 0.28, 0.29), 0.4)),
            box_thing([-3.0, 1.4, -0.8], [3.0, 1.5, 2.0], tile_paint((0.62, 0.64, 0.66), (0.62, 0.64, 0.66), 1.0)),
        ]
    )
    pose = look_at(_EYE, _TARGET)[0]
    view = render(scene, _SIZE, _K, pose)
    rng = np.random.default_rng(_SEED)
    depth = DepthSensor().measure(view.depth, view.cosine, rng)
    given.out.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(depth * 1000.0).astype(np.uint16)).save(given.out / "depth.png", optimize=True)
    Image.fromarray(view.colors).save(given.out / "color.png", optimize=True)
    Image.fromarray((view.thing == 0).astype(np.uint8) * 255).save(given.out / "mask.png", optimize=True)
    (given.out / "mask.json").write_text(json.dumps({"mask": "mask.png"}) + "\n")
    camera = {"fx": _K[0, 0], "fy": _K[1, 1], "cx": _K[0, 2] - 0.5, "cy": _K[1, 2] - 0.5, "depth_unit": 0.001}
    (given.out / "camera.json").write_text(json.dumps(camera | {"width": _SIZE[1], "height": _SIZE[0]}) + "\n")
    model = trimesh.load(given.meshes / "concrete_cat_statue.glb", force="mesh")
    model.apply_scale(1000.0)
    model.export(given.out / "cat.stl")
    T = np.linalg.inv(pose) @ poses["concrete_cat_statue"] @ np.diag([0.001, 0.001, 0.001, 1.0])
    (given.out / "truth.json").write_text(json.dumps({"T_camera_object": T.tolist()}) + "\n")


if __name__ == "__main__":
    main()
