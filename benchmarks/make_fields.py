"""Fit the benchmark's fields: three furnished rooms and their library objects, each in a frame of its own scale.

    python -m benchmarks.make_fields MESHES ROOMS OUT

MESHES holds the rooms' meshes (glb, metres, z up), ROOMS the layouts (ac-room.json, atbl-room.json, mix-room.json).
Writes a safe field a room and an object, and pairs.json: every detection with its true transform. About 45 minutes on
one core; what exists already is kept.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from scripts import make_demo_fields as demo

UNITS_PER_METRE = {"c": 0.9, "dc": 0.8, "fc": 0.625, "fc-nop": 0.7, "mc": 0.5, "et": 1.8, "t": 0.6, "wt": 1.3}
"""Object units a metre, by the object's name in the paper; scenes have 0.5: true scales run from 1 to 3.6."""
ROOM_OPTIONS = replace(demo.ROOM_OPTIONS, iterations=2500, near_points=600_000, volume_points=150_000)
OBJECT_OPTIONS = replace(demo.CHAIR_OPTIONS, iterations=1500, near_points=250_000, volume_points=60_000)


def fit_object(meshes: Path, instance: dict[str, Any], path: Path) -> None:
    name = instance["id"]
    mesh = demo.load_instance(meshes, instance)
    target = mesh.transformed(demo.object_from_mesh(mesh, UNITS_PER_METRE[name]))
    demo.fit(target, path, OBJECT_OPTIONS, name, [Path(instance["mesh"]).stem])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("rooms", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    pairs: list[dict[str, Any]] = []
    for name in ("ac-room", "atbl-room", "mix-room"):
        room = json.loads((arguments.rooms / f"{name}.json").read_text())
        path = arguments.out / f"{name}.safetensors"
        if not path.exists():
            names = sorted({Path(instance["mesh"]).stem for instance in room["instances"]})
            demo.fit(demo.compose_room(arguments.meshes, room), path, ROOM_OPTIONS, name, names)
        for instance in room["instances"]:
            if instance["id"] not in UNITS_PER_METRE:
                continue
            path = arguments.out / f"{instance['id']}.safetensors"
            if not path.exists():
                fit_object(arguments.meshes, instance, path)
            mesh = demo.load_instance(arguments.meshes, instance)
            true = demo.truth(instance, mesh, UNITS_PER_METRE[instance["id"]])
            detection = demo.detection(instance)
            pairs.append({"room": name, "object": instance["id"], "detection": detection, "truth": true})
    (arguments.out / "pairs.json").write_text(json.dumps(pairs, indent=1) + "\n")


if __name__ == "__main__":
    main()
