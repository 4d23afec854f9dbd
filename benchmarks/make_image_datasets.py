"""Render the benchmark's posed RGB-D images: library objects, rooms walked through, and single bad views of chairs.

    python -m benchmarks.make_image_datasets MESHES ROOMS OUT [--only objects rooms single] [--exact]

MESHES and ROOMS are those of benchmarks.make_fields, and so are the frames: what is fitted to these images compares
with the fields and the truths made there. Each dataset is a folder in the sdfstudio data format. What exists already is
kept as long as manifest.json says that it was made from the same inputs. About 6 minutes on one core, 120 MB.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.make_fields import UNITS_PER_METER
from benchmarks.worlds.composing import RenderOptions, render_object, render_room
from benchmarks.worlds.dataset_writer import write_dataset
from benchmarks.worlds.layouts import Layout, read_layout
from regnf_data.posed_images import PosedImages

ROOMS = ("ac-room", "atbl-room", "mix-room")
SINGLE_VIEW_ROOM = "ac-room"
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Dataset:
    """One dataset to be made. inputs: the files it is made from · settings: everything else that it depends on."""

    kind: str
    name: str
    inputs: Sequence[Path]
    settings: dict[str, Any]
    make: Callable[[], PosedImages]

    def digest(self) -> str:
        """SHA-256 of the inputs' contents and the settings."""
        told = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode())
        for path in self.inputs:
            told.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
        return told.hexdigest()


def datasets(meshes: Path, rooms: Path, base: RenderOptions) -> list[Dataset]:
    """All of them: objects first, then single views, then rooms."""
    layouts = {name: read_layout(rooms / f"{name}.json", meshes) for name in ROOMS}
    found = []
    objects = {piece.name: piece.mesh for layout in layouts.values() for piece in layout.furnishings}
    clutter = {
        instance["id"]
        for name in ROOMS
        for instance in json.loads((rooms / f"{name}.json").read_text())["instances"]
        if instance["class"] == "clutter"
    }
    for name, mesh in sorted(objects.items()):
        if name not in clutter:
            found.append(_object(name, mesh, base))
    for piece in layouts[SINGLE_VIEW_ROOM].furnishings:
        options = replace(base, trajectory="single")
        found.append(_room("single", layouts[SINGLE_VIEW_ROOM], rooms, options, piece.name))
    for layout in layouts.values():
        for options in (replace(base, trajectory="short"), replace(base, trajectory="long")):
            found.append(_room("rooms", layout, rooms, options, None))
    return found


def _object(name: str, mesh: Path, options: RenderOptions) -> Dataset:
    units = UNITS_PER_METER[name]
    return Dataset(
        "objects",
        name,
        [mesh],
        {"options": asdict(options), "units_per_meter": units},
        lambda: render_object(mesh, options, units_per_meter=units),
    )


def _room(kind: str, layout: Layout, rooms: Path, options: RenderOptions, instance: str | None) -> Dataset:
    units = {piece.name: UNITS_PER_METER[piece.name] for piece in layout.furnishings}
    return Dataset(
        kind,
        f"{layout.name}-{options.trajectory}" + ("" if instance is None else f"-{instance}"),
        [rooms / f"{layout.name}.json", *sorted({piece.mesh for piece in layout.furnishings})],
        {"options": asdict(options), "object_units_per_meter": units, "instance": instance},
        lambda: render_room(layout, options, object_units_per_meter=units, instance=instance),
    )


def make(dataset: Dataset, out: Path, manifest: dict[str, Any]) -> None:
    """Render one dataset unless the manifest says that it is there already."""
    folder = out / dataset.name
    digest = dataset.digest()
    if folder.is_dir() and manifest.get(dataset.name, {}).get("inputs_sha256") == digest:
        return
    started = time.monotonic()
    images = dataset.make()
    seconds = time.monotonic() - started
    if folder.exists():
        shutil.rmtree(folder)
    write_dataset(images, folder)
    manifest[dataset.name] = {
        "kind": dataset.kind,
        "inputs_sha256": digest,
        "inputs": [path.name for path in dataset.inputs],
        "settings": dataset.settings,
        "images": len(images),
        "size": list(images.size),
        "instances": [instance.label for instance in images.instances],
        "bytes": sum(path.stat().st_size for path in folder.iterdir()),
        "seconds": round(seconds, 1),
    }
    (out / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    print(f"{dataset.name}: {len(images)} images in {seconds:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("rooms", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=("objects", "single", "rooms"), help="all by default")
    parser.add_argument("--exact", action="store_true", help="exact depths: no sensor noise")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / MANIFEST
    manifest = json.loads(path.read_text()) if path.exists() else {}
    base = RenderOptions(sensor=None) if arguments.exact else RenderOptions()
    for dataset in datasets(arguments.meshes, arguments.rooms, base):
        if arguments.only is None or dataset.kind in arguments.only:
            make(dataset, arguments.out, manifest)


if __name__ == "__main__":
    main()
