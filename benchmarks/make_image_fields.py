"""Fit the benchmark's fields to posed RGB-D images, as users make them, and list the pairs they make up.

    python -m benchmarks.make_image_fields MESHES ROOMS IMAGES FIELDS [--only objects rooms single] [--names NAME ...]

IMAGES is the folder of benchmarks.make_image_datasets; MESHES and ROOMS what it was rendered from. FIELDS gets the same
kind of files as that of benchmarks.make_fields, so every table that reads the one reads the other:

pairs.json                    rooms walked through at length, objects from 60 views
pairs-after-N-percent.json    the same rooms after 1, 3 and 10 % of their training, the objects trained in full
pairs-short.json              rooms from a short walk past
pairs-single.json             rooms from one bad view, a chair each

What exists is kept. On one core about 2 minutes an object, 5 a room, 2 a single view.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.make_fields import UNITS_PER_METER, surface
from regnf_data.sdfstudio import load_dataset
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.options import ReconstructionOptions
from scripts import make_demo_fields as demo

ROOMS = ("ac-room", "atbl-room", "mix-room")
SINGLE_VIEW_ROOM = "ac-room"
PERCENTS = (1, 3, 10)
KINDS = ("objects", "rooms", "single")
OPTIONS = ReconstructionOptions()
"""The defaults, as a user gets them."""


@dataclass(frozen=True)
class Fit:
    """One fit. images: the dataset's name · name: the field's · snapshots: percents of the training kept as well."""

    kind: str
    images: str
    name: str
    snapshots: tuple[int, ...] = ()


@dataclass(frozen=True)
class PairList:
    """Which scenes' fields a list of pairs is made of. suffix: after the layout's name · one: a scene an instance."""

    file: str
    suffix: str
    layouts: tuple[str, ...] = ROOMS
    one: bool = False


PAIR_LISTS = (
    PairList("pairs.json", ""),
    PairList("pairs-short.json", "-short"),
    PairList("pairs-single.json", "-single", (SINGLE_VIEW_ROOM,), one=True),
    *(PairList(f"pairs-after-{percent}-percent.json", f"-after-{percent}-percent") for percent in PERCENTS),
)


def fits(images: Path) -> Iterator[Fit]:
    """All of them, told from the datasets that there are."""
    names = sorted(path.name for path in images.iterdir() if (path / "meta_data.json").exists())
    for name in names:
        if name in UNITS_PER_METER:
            yield Fit("objects", name, name)
        elif "-single-" in name:
            yield Fit("single", name, name)
        elif name.endswith("-long"):
            yield Fit("rooms", name, name.removesuffix("-long"), PERCENTS)
        elif name.endswith("-short"):
            yield Fit("rooms", name, name)


def make(fit: Fit, images: Path, fields: Path) -> None:
    """One field and what its fit measured."""
    path = fields / f"{fit.name}.safetensors"
    if path.exists():
        return

    def show(iteration: int, loss: float, seconds_left: float) -> None:
        if iteration % 500 == 0:
            sys.stderr.write(f"{fit.name}: iteration {iteration}, loss {loss:.4f}, {seconds_left:.0f} s left\n")

    files = FitFiles(path, path.with_suffix(".checkpoint"), tuple(percent / 100 for percent in fit.snapshots))
    source = {"dataset": fit.images, "attribution": demo.ATTRIBUTION}
    posed = load_dataset(images / fit.images)
    report = reconstruct(posed, files, OPTIONS, device="cpu", progress=show, label=fit.name, source=source)
    path.with_suffix(".fit.json").write_text(json.dumps(asdict(report), indent=1) + "\n")


def list_pairs(wanted: PairList, meshes: Path, rooms: Path, fields: Path) -> None:
    """Write the list of those pairs whose fields are there, unless there are none."""
    pairs = []
    for stem in wanted.layouts:
        room = json.loads((rooms / f"{stem}.json").read_text())
        for instance in room["instances"]:
            name = instance["id"]
            scene = f"{stem}{wanted.suffix}" + (f"-{name}" if wanted.one else "")
            if name in UNITS_PER_METER and instance["class"] != "clutter" and _both(fields, scene, name):
                pairs.append(describe_pair(room, instance, scene, meshes))
    if pairs:
        (fields / wanted.file).write_text(json.dumps(pairs, indent=1) + "\n")


def _both(fields: Path, *names: str) -> bool:
    return all((fields / f"{name}.safetensors").exists() for name in names)


def describe_pair(room: dict[str, Any], instance: dict[str, Any], scene: str, meshes: Path) -> dict[str, Any]:
    """One entry of a list of pairs: the detection and the truth of an instance in the scene's field ``scene``."""
    frame, name = demo.SceneFrame.of(room), instance["id"]
    truth = demo.truth(instance, demo.load_instance(meshes, instance), UNITS_PER_METER[name], frame)
    detection = demo.detection(instance, frame)
    return {"room": scene, "object": name, "instance": name, "detection": detection, "truth": truth}


def write_surface(room: Path, meshes: Path, fields: Path) -> None:
    """The exact surface of a furnished room, beside its field."""
    path = fields / f"{room.stem}.surface.npz"
    if not path.exists():
        vertices, faces = surface(demo.compose_room(meshes, json.loads(room.read_text())))
        np.savez_compressed(path, vertices=vertices.astype(np.float32), faces=faces)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("meshes", "rooms", "images", "fields"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--names", nargs="+", help="datasets; all by default")
    arguments = parser.parse_args()
    arguments.fields.mkdir(parents=True, exist_ok=True)
    for fit in fits(arguments.images):
        if fit.kind in arguments.only and (arguments.names is None or fit.images in arguments.names):
            make(fit, arguments.images, arguments.fields)
    for stem in ROOMS:
        write_surface(arguments.rooms / f"{stem}.json", arguments.meshes, arguments.fields)
    for wanted in PAIR_LISTS:
        list_pairs(wanted, arguments.meshes, arguments.rooms, arguments.fields)


if __name__ == "__main__":
    main()
