"""The same rooms' fields with what their images saw, with what their cameras' places alone tell, and with nothing.

    python -m benchmarks.observation_sources MESHES ROOMS IMAGES FIELDS NAME [NAME ...]

The folders are those of benchmarks.make_image_fields; NAME is a room's dataset, such as ac-room-short, whose field is
FIELDS/NAME.safetensors. Prints a line a registration, then the successes by source. On one core about a minute a room
for the observations, and 5 to 15 s a registration.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.make_fields import UNITS_PER_METER
from benchmarks.make_image_fields import describe_pair
from benchmarks.robust.cases import Case, pair_of
from benchmarks.robust.judging import SUCCESSES
from benchmarks.robust.runs import Job, run_one, summary
from benchmarks.robust.symmetries import declared
from regnf_core import SdfField
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import ObservedField
from regnf_core.importing.gate.gate import FIELD_NAME, import_field
from regnf_data.sdfstudio import METADATA, load_dataset
from regnf_fit.images.observing import attach_observation


def sources(field: Path, dataset: Path, scratch: Path) -> dict[str, SdfField]:
    """The field of one room by where its observation is from."""
    bare = open_field(field)
    bare = bare.field if isinstance(bare, ObservedField) else bare
    by_images = scratch / "images.safetensors"
    shutil.copy(field, by_images)
    attach_observation(by_images, load_dataset(dataset))
    import_field(field, scratch, cameras=dataset / METADATA)
    return {"images": open_field(by_images), "cameras": open_field(scratch / FIELD_NAME), "nothing": bare}


def run_room(name: str, folders: argparse.Namespace, seeds: int) -> Counter[str]:
    """Every object of one room, with every source: how often each succeeded."""
    layout = folders.rooms / f"{name.rsplit('-', 1)[0]}.json"
    room, won = json.loads(layout.read_text()), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        scenes = sources(folders.fields / f"{name}.safetensors", folders.images / name, Path(scratch))
    for instance in room["instances"]:
        if instance["id"] not in UNITS_PER_METER or instance["class"] == "clutter":
            continue
        pair = pair_of(folders.fields, describe_pair(room, instance, name, folders.meshes))
        obj = open_field(folders.fields / f"{pair.object}.safetensors")
        for source, scene in scenes.items():
            case = Case(pair.name, scene, obj, pair.detection, pair.truth, declared(pair.instance))
            for seed in range(seeds):
                run = run_one(Job(lambda case=case: case, source, seed))  # type: ignore[misc]
                won[source] += run["category"] in SUCCESSES
                won["runs"] += source == "images"
                print(summary(run), flush=True)
    return won


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for folder in ("meshes", "rooms", "images", "fields"):
        parser.add_argument(folder, type=Path)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    total = Counter[str]()
    for name in arguments.names:
        total += run_room(name, arguments, arguments.seeds)
    print(", ".join(f"{source} {total[source]} of {total['runs']}" for source in ("images", "cameras", "nothing")))


if __name__ == "__main__":
    main()
