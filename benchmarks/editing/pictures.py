"""Pictures of edited scenes, as in the Reg-NF paper's figures.

    python -m benchmarks.editing.pictures FIELDS [--output docs/images/editing] [--only NAME ...] [--size 480x360]

FIELDS is the folder of benchmarks.make_image_fields or benchmarks.make_fields (pairs.json, pairs-short.json,
pairs-after-1-percent.json, pairs-after-3-percent.json; what is missing is left out). Poses are those of ``register``,
not the true ones. Each picture is before above after, or before beside after; 10 minutes on one idle core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from benchmarks.editing.scenes import TINTS, Found, found, overview, pairs_of
from benchmarks.robust.cases import Pair
from regnf_core import (
    Insertion,
    OrientedBox,
    Removal,
    RenderOptions,
    Replacement,
    SdfField,
    Substitution,
    compose,
    open_field,
)
from regnf_core.editing.edited_scene import without_unseen
from regnf_core.rendering.camera import Camera, orbit_cameras
from regnf_core.rendering.job import strip
from regnf_core.rendering.render import render
from regnf_core.rendering.request import OrbitRequest

ROOMS = ("ac-room", "atbl-room", "mix-room")
OPTIONS = RenderOptions(antialias=2, cut_away=True)
_QUICK = RenderOptions(cut_away=True)
_GAP = 6
Size = tuple[int, int]


def substitution(fields: Path, room: str, size: Size) -> Image.Image | None:
    """The room from above, and with its registered objects in color."""
    shots = _substituted(fields, room, pairs_of(fields, "pairs.json", room), size)
    return _stacked(shots) if shots else None


def colors(fields: Path, size: Size) -> Image.Image | None:
    """A room fitted to images as it is, and with its registered objects: all in their own colors."""
    room = "mix-room"
    shots = _substituted(fields, room, pairs_of(fields, "pairs.json", room), size, tinted=False)
    return Image.fromarray(strip(_flat(shots))) if shots else None


def under_trained(fields: Path, size: Size) -> Image.Image | None:
    """The same of a room's field after 1 and 3 % of its training, beside each other; the objects are fully trained."""
    columns = []
    for percent in (1, 3):
        room = f"mix-room-after-{percent}-percent"
        listed = pairs_of(fields, f"pairs-after-{percent}-percent.json", room)
        columns.append(_substituted(fields, room, [replace(pair, object=pair.instance) for pair in listed], size))
    rows = [_flat(list(row)) for row in zip(*columns, strict=True)]
    return _stacked(rows) if rows else None


def _substituted(
    fields: Path, room: str, pairs: Sequence[Pair], size: Size, tinted: bool = True
) -> list[list[np.ndarray]]:
    """The room from above, before and after; nothing where the list of pairs is missing."""
    if not pairs:
        return []
    scene = open_field(fields / f"{room}.safetensors")
    things = [one for one in (found(pair, scene) for pair in pairs) if one.verdict != "rejected"]
    print(room, [(one.pair.object, one.verdict) for one in things], flush=True)
    edits = [
        Substitution(one.obj, one.T_object_scene, one.residual, TINTS[number % len(TINTS)] if tinted else None)
        for number, one in enumerate(things)
    ]
    return _shots(scene, compose(scene, edits), [overview(scene, size)])


def completion(fields: Path, size: Size) -> Image.Image | None:
    """A chair of the short walk from three sides, without and with the library's own."""
    room, name = "ac-room-short", "mc"
    pairs = [pair for pair in pairs_of(fields, "pairs-short.json", room) if pair.object == name]
    if not pairs:
        return None
    scene = open_field(fields / f"{room}.safetensors")
    one = found(pairs[0], scene)
    print(room, one.pair.object, one.verdict, flush=True)
    measured = without_unseen(scene)
    edited = compose(measured, [Substitution(one.obj, one.T_object_scene, one.residual, TINTS[0])])
    return _stacked(_shots(measured, edited, _round(edited.places[0], size, 3)))


def replacement(fields: Path, size: Size) -> Image.Image | None:
    """A dining chair, and an armchair in its place."""
    one, scene = _registered(fields, "ac-room", "dc")
    if one is None or scene is None:
        return None
    other = open_field(fields / "mc.safetensors")
    edit = Replacement(one.obj, one.T_object_scene, other, residual=one.residual, tint=TINTS[1])
    return Image.fromarray(strip(_flat(_shots(scene, compose(scene, [edit]), [_near(one, scene, size)]))))


def removal(fields: Path, size: Size) -> Image.Image | None:
    """A room with and without one of its chairs."""
    one, scene = _registered(fields, "ac-room", "fc")
    if one is None or scene is None:
        return None
    edit = Removal(obj=one.obj, T_object_scene=one.T_object_scene, residual=one.residual)
    return Image.fromarray(strip(_flat(_shots(scene, compose(scene, [edit]), [_near(one, scene, size)]))))


def _registered(fields: Path, room: str, name: str) -> tuple[Found | None, SdfField | None]:
    pairs = [pair for pair in pairs_of(fields, "pairs.json", room) if pair.object == name]
    if not pairs:
        return None, None
    scene = open_field(fields / f"{room}.safetensors")
    return found(pairs[0], scene), scene


def _near(one: Found, scene: SdfField, size: Size) -> Camera:
    """The thing and what is around it, from where most of it is seen past the other things."""
    box = one.pair.detection
    wide = OrientedBox(box.center, box.size * 1.7, box.rotation)
    shown = compose(scene, [Insertion(one.obj, one.T_object_scene)])
    cameras = orbit_cameras(OrbitRequest(frames=8, elevation_deg=28.0, start_deg=22.0), wide, size)
    low, high = scene.bounds
    within = [camera for camera in cameras if bool(((camera.position > low) & (camera.position < high)).all())]
    seen = [int((render(shown, one.resized((40, 30)), _QUICK).part == 1).sum()) for one in within or cameras]
    return (within or cameras)[int(np.argmax(seen))]


def _round(box: OrientedBox, size: Size, views: int) -> list[Camera]:
    return orbit_cameras(OrbitRequest(frames=views, elevation_deg=22.0, start_deg=45.0), box, size)


def _shots(before: SdfField, after: SdfField, cameras: Sequence[Camera]) -> list[list[np.ndarray]]:
    return [[render(field, camera, OPTIONS).color for camera in cameras] for field in (before, after)]


def _flat(rows: list[list[np.ndarray]]) -> list[np.ndarray]:
    return [picture for row in rows for picture in row]


def _stacked(rows: list[list[np.ndarray]]) -> Image.Image:
    strips = [strip(row) for row in rows]
    gap = np.full((_GAP, strips[0].shape[1], 3), 255, np.uint8)
    return Image.fromarray(np.concatenate([part for row in strips for part in (gap, row)][1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--output", type=Path, default=Path("docs/images/editing"))
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--size", default="400x300")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    width, height = (int(word) for word in arguments.size.split("x"))
    fields, size = arguments.fields, (width, height)
    small = (width * 2 // 3, height * 2 // 3)
    makers: dict[str, Callable[[], Image.Image | None]] = {
        "removal": lambda: removal(fields, small),
        "replacement": lambda: replacement(fields, small),
        "completion": lambda: completion(fields, small),
        **{f"substitution-{room}": (lambda room=room: substitution(fields, room, size)) for room in ROOMS},
        "colors": lambda: colors(fields, size),
        "under-trained": lambda: under_trained(fields, (width * 3 // 4, height * 3 // 4)),
    }
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name, make in makers.items():
        if arguments.only is None or name in arguments.only:
            picture = make()
            print(name, "nothing to show" if picture is None else picture.size, flush=True)
            if picture is not None:
                picture.save(arguments.output / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
