"""Make the library of 64 distinct objects that the library search is measured on.

    python -m benchmarks.make_library MESHES FIELDS

MESHES holds the given meshes (glb, meters, z up); FIELDS is the folder that benchmarks.make_fields wrote, whose fields
of the given objects are used. The others, which no detection shows, are written into FIELDS/library as exact distances
to their meshes; library.json lists all 64 with their models (FIELDS/library/*.model). What exists is kept.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.robust.library_objects import GIVEN, library_meshes
from regnf_core import open_field
from regnf_core.fields.mesh import MeshField
from regnf_core.library import model_object, write_object_model
from regnf_core.schema.safe_format import write_safe_field
from scripts import make_demo_fields as demo

INSTANCES = {
    "painted_wooden_chair_01": "c", "dining_chair_02": "dc", "modern_arm_chair_01": "fc",
    "modern_arm_chair_01_nopillow": "fc-nop", "mid_century_lounge_chair": "mc", "woodentable_02": "et",
    "coffeetable_01": "t", "side_table_01": "wt",
}  # fmt: skip
"""The names that the paper gives to some of the given objects."""
_LARGEST = 1.2  # object units


def instance(name: str) -> str:
    """What benchmarks.make_fields calls a given object."""
    return INSTANCES.get(name, name)


def write_missing(name: str, mesh: MeshField, path: Path) -> None:
    """An object that no other benchmark uses, as the exact distance to its mesh, its largest edge 1.2 units."""
    if path.exists():
        return
    low, high = mesh.bounds
    target = mesh.transformed(demo.object_from_mesh(mesh, _LARGEST / float((high - low).max())))
    description = {"kind": "mesh", "bounds": target.bounds.tolist(), "label": name}
    tensors = {"vertices": target.vertices.astype(np.float32), "faces": target.faces.astype(np.int32)}
    write_safe_field(path, description, tensors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("fields", type=Path)
    arguments = parser.parse_args()
    folder = arguments.fields / "library"
    folder.mkdir(exist_ok=True)
    entries = []
    for name, mesh in library_meshes(arguments.meshes):
        path = folder / f"{name.replace(' ', '-')}.safetensors"
        if name in GIVEN and (known := arguments.fields / f"{instance(name)}.safetensors").exists():
            path = known
        write_missing(name, mesh, path)
        model = folder / f"{name.replace(' ', '-')}.model"
        write_object_model(model, model_object(open_field(path)))
        entries.append({"name": instance(name), "field": str(path.relative_to(arguments.fields)), "model": model.name})
    (folder / "library.json").write_text(json.dumps(entries, indent=1) + "\n")


if __name__ == "__main__":
    main()
