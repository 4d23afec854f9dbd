"""Fit the benchmark's fields: furnished scenes and their library objects, each in a frame of its own scale.

    python -m benchmarks.make_fields MESHES ROOMS OUT [--only SET ...] [--layouts NAME ...] [--exact CELLS CELLS]

MESHES holds the meshes (glb, meters, z up), ROOMS the layouts ac-room.json, atbl-room.json and mix-room.json; the
held-out scenes are laid out in benchmarks/layouts. Writes a safe field a scene and an object, the scene's exact surface
beside its field (NAME.surface.npz), and for each set a list of detections with their true transforms. What exists
already is kept. On one core: main 20 minutes, held-out 15, under-trained 25, full-size 15.

With --exact the fields are dense grids of exact distances in place of fits, with so many cells along the longest edge
of a room and of an object.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.simple_meshes import box, together
from benchmarks.solids import BoxField, UnionField
from regnf_core.editing.storing import write_field
from regnf_core.fields.mesh import MeshField
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_fit.options import FitOptions
from scripts import make_demo_fields as demo

UNITS_PER_METER = {
    "c": 0.9, "dc": 0.8, "fc": 0.625, "fc-nop": 0.7, "mc": 0.5, "et": 1.8, "t": 0.6, "wt": 1.3,
    "schoolchair_01": 0.75, "plastic_monobloc_chair_01": 0.55, "outdoor_folding_chair": 0.95,
    "round_wooden_table_02": 0.8, "boombox": 1.1, "ceramic_vase_01": 2.4, "vintage_electric_kettle": 1.6,
    "concrete_cat_statue": 3.0, "ycb_002_master_chef_can": 4.5, "ycb_004_sugar_box": 5.0,
}  # fmt: skip
"""Object units a meter, by the instance's name; rooms have 0.5, the table top 1.8: true scales from 0.6 to 3.6."""
YCB = "YCB object set, https://www.ycbbenchmarks.com, CC BY 4.0"
LAYOUTS = Path(__file__).parent / "layouts"
ROOM_OPTIONS = replace(demo.ROOM_OPTIONS, iterations=2500, near_points=600_000, volume_points=150_000)
OBJECT_OPTIONS = replace(demo.CHAIR_OPTIONS, iterations=1500, near_points=250_000, volume_points=60_000)
FULL_GRID = HashGridConfig.from_top_resolution(2048, levels=16, log2_table_size=19)
"""With a base resolution of 16: the size that neus-facto comes with."""


@dataclass(frozen=True)
class FieldSet:
    """Scenes and objects made alike, by a fit or, of ``int`` cells along the longest edge, as a grid.

    suffix: of the fields' names · only: the one instance wanted, else all.
    """

    pairs: str
    layouts: Sequence[Path]
    room_options: FitOptions | int = ROOM_OPTIONS
    object_options: FitOptions | int = OBJECT_OPTIONS
    suffix: str = ""
    only: str | None = None


def field_sets(rooms: Path) -> dict[str, list[FieldSet]]:
    """What can be made, by the name that --only knows it by; ``rooms`` holds the main layouts."""
    main = [rooms / f"{name}.json" for name in ("ac-room", "atbl-room", "mix-room")]
    held_out = [LAYOUTS / "held-out-room.json", LAYOUTS / "held-out-table-top.json"]
    full_room = replace(ROOM_OPTIONS, iterations=2000, grid=FULL_GRID, hidden_width=256)
    full_object = replace(OBJECT_OPTIONS, iterations=1200, grid=FULL_GRID, hidden_width=256)
    return {
        "main": [FieldSet("pairs.json", main)],
        "held-out": [FieldSet("pairs-held-out.json", held_out)],
        "under-trained": [
            FieldSet(
                f"{pairs}-after-{percent}-percent.json",
                layouts,
                replace(ROOM_OPTIONS, iterations=ROOM_OPTIONS.iterations * percent // 100),
                replace(OBJECT_OPTIONS, iterations=OBJECT_OPTIONS.iterations * percent // 100),
                f"-after-{percent}-percent",
            )
            for pairs, layouts in (("pairs", main), ("pairs-held-out", held_out))
            for percent in (1, 3, 10)
        ],
        "full-size": [FieldSet("pairs-full-size.json", main[2:], full_room, full_object, "-full-size", "fc")],
    }


def make(fields: FieldSet, meshes: Path, out: Path) -> None:
    """Fit what is missing of one set, then list its pairs."""
    pairs = []
    for layout in fields.layouts:
        room = json.loads(layout.read_text())
        frame = demo.SceneFrame.of(room)
        name = layout.stem + fields.suffix
        fit_room(meshes, room, out / f"{name}.safetensors", fields.room_options)
        for instance in room["instances"]:
            identifier = instance["id"]
            if identifier not in UNITS_PER_METER or instance["class"] == "clutter":
                continue
            if fields.only not in (None, identifier):
                continue
            units = UNITS_PER_METER[identifier]
            mesh = demo.load_instance(meshes, instance)
            path = out / f"{identifier}{fields.suffix}.safetensors"
            fit_object(mesh, units, path, fields.object_options, instance)
            pairs.append(
                {
                    "room": name,
                    "object": path.stem,
                    "instance": identifier,
                    "detection": demo.detection(instance, frame),
                    "truth": demo.truth(instance, mesh, units, frame),
                }
            )
    (out / fields.pairs).write_text(json.dumps(pairs, indent=1) + "\n")


def fit_room(meshes: Path, room: dict[str, Any], path: Path, options: FitOptions | int) -> None:
    """The furnished scene's field and, beside it, its exact surface."""
    target = demo.compose_room(meshes, room)
    if not path.with_suffix(".surface.npz").exists():
        vertices, faces = surface(target)
        np.savez_compressed(path.with_suffix(".surface.npz"), vertices=vertices.astype(np.float32), faces=faces)
    if not path.exists():
        names = sorted({Path(instance["mesh"]).stem for instance in room["instances"]})
        write(target, path, options, names)


def fit_object(mesh: MeshField, units: float, path: Path, options: FitOptions | int, instance: dict[str, Any]) -> None:
    """A library object's field, the mesh's middle at the origin."""
    if not path.exists():
        target = mesh.transformed(demo.object_from_mesh(mesh, units))
        source = Path(instance["mesh"]).stem
        write(target, path, options, [source])


def write(target: MeshField | UnionField, path: Path, options: FitOptions | int, names: Sequence[str]) -> None:
    """The field of exact distances, fitted or as a grid. names: of the meshes."""
    if isinstance(options, int):
        write_field(target, path, options)
    else:
        demo.fit(target, path, options, path.stem, names, attribution(names))


def surface(room: UnionField) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Triangles of everything in the room: vertices (V, 3), faces (F, 3)."""
    parts = [box(part.lower, part.upper) if isinstance(part, BoxField) else part for part in room.parts]
    mesh = together(*(part for part in parts if isinstance(part, MeshField)))
    return mesh.vertices, mesh.faces.astype(np.int32)


def attribution(names: Sequence[str]) -> str:
    """Whom the meshes are owed to."""
    return demo.ATTRIBUTION + (f"; {YCB}" if any(name.startswith("ycb_") for name in names) else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("rooms", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=sorted(field_sets(Path())), help="sets to make; all by default")
    parser.add_argument("--layouts", nargs="+", help="rooms to make and list, by the layout; all by default")
    parser.add_argument("--exact", nargs=2, type=int, metavar="CELLS", help="grids of exact distances; of `main` alone")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    chosen = field_sets(arguments.rooms)
    if arguments.exact is not None:
        room, thing = arguments.exact
        chosen = {"main": [replace(one, room_options=room, object_options=thing) for one in chosen["main"]]}
    for name, sets in chosen.items():
        if arguments.only is None or name in arguments.only:
            for fields in sets:
                layouts = [one for one in fields.layouts if arguments.layouts is None or one.stem in arguments.layouts]
                if layouts:
                    make(replace(fields, layouts=layouts), arguments.meshes, arguments.out)


if __name__ == "__main__":
    main()
