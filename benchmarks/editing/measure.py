"""How near edited and rendered scenes come to the truth, and how long a frame takes.

    python -m benchmarks.editing.measure FIELDS MESHES ROOMS [--output benchmarks/results/rendering.md] [--views 4]

FIELDS as for benchmarks.editing.pictures; MESHES and ROOMS what they were made from. Truth: rays cast at the meshes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.editing.scenes import Found, found, overview, pairs_of
from benchmarks.random_worlds.mesh import ExactScene, ExactView, Mesh
from benchmarks.robust.cases import Pair
from benchmarks.robust.symmetries import declared
from benchmarks.symmetric_errors import mssd
from regnf_core import Insertion, Removal, RenderOptions, SdfField, Sim3, Substitution, compose, open_field
from regnf_core.editing.edited_scene import without_unseen
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import CountingField
from regnf_core.rendering.camera import Camera, orbit_cameras
from regnf_core.rendering.render import render, render_frames
from regnf_core.rendering.request import OrbitRequest
from scripts import make_demo_fields as demo

SIZE = (160, 120)
_LEAST_VISIBLE = 0.5
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """A picture's comparison. error: median over common pixels, object diameters · iou: of the silhouettes."""

    error: float
    iou: float


@dataclass(frozen=True, eq=False)
class Truth:
    """Meshes in the scene's frame: the pair's object alone, and all things of the room, the object first."""

    alone: ExactScene
    among: ExactScene

    def depth(self, camera: Camera) -> Floats:
        """(H, W) of the object alone, along the viewing axis, 0 where it is missed."""
        return _view(self.alone, camera).depth

    def shows(self, camera: Camera) -> NDArray[np.bool_]:
        """(H, W): where no other thing hides the object. Floor and walls are not looked at."""
        return _view(self.among, camera).thing == 0


def _view(scene: ExactScene, camera: Camera) -> ExactView:
    K = np.array([[camera.focal[0], 0, camera.middle[0]], [0, camera.focal[1], camera.middle[1]], [0, 0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.axes.numpy(), camera.position.numpy()
    return scene.view((camera.height, camera.width), K, pose)


def truth_of(one: Found, meshes: Path, rooms: Path) -> Truth:
    """The pair's mesh at its true pose, and the other things of its room."""
    room = json.loads((rooms / f"{one.pair.room.split('-room')[0]}-room.json").read_text())
    parts = [part for part in demo.compose_room(meshes, room).parts if isinstance(part, MeshField)]
    things = {
        instance["id"]: Mesh(part.vertices, part.faces) for instance, part in zip(room["instances"], parts, strict=True)
    }
    thing = things.pop(one.pair.instance)
    return Truth(ExactScene([thing]), ExactScene([thing, *things.values()]))


def seen(edited: SdfField, part: int, truth: Truth, camera: Camera, diameter: float) -> Seen | None:
    """The part of an edited scene that is an object, against its mesh, behind what hides it in truth.

    None where walls and other things hide most of it.
    """
    frame = render(edited, camera, RenderOptions(cut_away=True))
    depth = truth.depth(camera)
    behind_a_wall = (frame.part == 0) & (frame.depth > 0) & (frame.depth < depth - 0.02 * diameter)
    mine, exact = frame.part == part, truth.shows(camera) & ~behind_a_wall
    if exact.sum() < _LEAST_VISIBLE * (depth > 0).sum():
        return None
    both = mine & exact
    error = np.median(np.abs(frame.depth - depth)[both]) / diameter if both.any() else np.nan
    return Seen(float(error), float(both.sum() / max((mine | exact).sum(), 1)))


def substituted(fields: Path, meshes: Path, rooms: Path, views: int) -> Iterator[str]:
    """A row an object: its depth and silhouette after its substitution at the registered pose."""
    for room in ("mix-room", "ac-room", "atbl-room"):
        scene = None
        for pair in pairs_of(fields, "pairs.json", room):
            scene = scene or open_field(fields / f"{room}.safetensors")
            one = found(pair, scene)
            edited = compose(scene, [Substitution(one.obj, one.T_object_scene, one.residual)])
            truth, diameter = truth_of(one, meshes, rooms), pair.diameter / float(pair.truth.scale)
            cameras = orbit_cameras(
                OrbitRequest(frames=views, elevation_deg=30.0, start_deg=45.0), edited.places[0], SIZE
            )
            views_of = [seen(edited, 1, truth, camera, diameter) for camera in cameras]
            shown = [one_view for one_view in views_of if one_view is not None]
            error, iou = (np.median([getattr(s, name) for s in shown]) for name in ("error", "iou"))
            yield f"| {room} | {pair.object} | {one.verdict} | {100 * error:.2f} % | {iou:.3f} |"


def unseen_back(fields: Path, meshes: Path, rooms: Path, views: int) -> Iterator[str]:
    """The depth of a chair of the short walk from all sides against its mesh, before and after its substitution.

    Both without matter that nobody saw. Pixels: those of the true silhouette; an error counts as one diameter at most.
    """
    for pair in pairs_of(fields, "pairs-short.json", "ac-room-short"):
        scene = open_field(fields / "ac-room-short.safetensors")
        one = found(pair, scene)
        measured = without_unseen(scene)
        edited = compose(measured, [Substitution(one.obj, one.T_object_scene, one.residual)])
        truth, diameter = truth_of(one, meshes, rooms), pair.diameter / float(pair.truth.scale)
        rows: list[tuple[float, float]] = []
        options = RenderOptions(cut_away=True)
        for camera in orbit_cameras(OrbitRequest(frames=views, elevation_deg=30.0), edited.places[0], SIZE):
            depth = truth.depth(camera)
            on = depth > 0
            errors = []
            for field in (measured, edited):
                found_depth = render(field, camera, options).depth
                errors.append(float(np.mean(np.minimum(np.abs(found_depth - depth)[on], diameter)) / diameter))
            rows.append((errors[0], errors[1]))
        before, after = max(rows)  # the side that the walk saw least of
        yield f"| {pair.object} | {one.verdict} | {100 * before:.2f} % | {100 * after:.2f} % | {before / after:.1f} |"


def frames(scene: SdfField, size: tuple[int, int]) -> Iterator[str]:
    """A row a mode: evaluations a pixel, seconds, and beside it even sampling with the same error."""
    camera = overview(scene, size)
    exact = render(scene, camera, RenderOptions(cut_away=True))
    for mode in ("surface", "volume"):
        counting = CountingField(scene)
        options = RenderOptions(mode=mode, cut_away=True)
        start, cpu = time.perf_counter(), time.process_time()
        frame = next(render_frames(counting, [camera], options))
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        error = _depth_error(frame.depth, exact.depth)
        pixels = size[0] * size[1]
        yield f"| {mode} | {counting.evaluations / pixels:.1f} | {wall:.1f} | {cpu:.1f} | {1e3 * error:.2f} |"
    for count in (64, 128, 256):
        start, cpu = time.perf_counter(), time.process_time()
        depth = _even(scene, camera, count)
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        error = _depth_error(depth, exact.depth)
        yield f"| {count} even samples | {count} | {wall:.1f} | {cpu:.1f} | {1e3 * error:.2f} |"


def _depth_error(depth: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
    both = (depth > 0) & (exact > 0)
    return float(np.mean(np.minimum(np.abs(depth - exact)[both], 0.1)))


def _even(scene: SdfField, camera: Camera, count: int) -> NDArray[np.float32]:
    """Depths by ``count`` even samples a ray, the zero by a line between the two that it lies between."""
    rays, cosine = camera.rays(torch.arange(camera.width * camera.height))
    low, high = scene.bounds
    t = torch.linspace(0.0, float((high - low).norm()), count)
    found_at = torch.zeros(len(cosine))
    for part in torch.arange(len(cosine)).split(1 << 12):
        points = rays.origins[part, None] + t[:, None] * rays.directions[part, None]
        d = scene.signed_distance(points.view(-1, 3)).view(len(part), count)
        crossing = (d[:, :-1] > 0) & (d[:, 1:] <= 0)
        first = crossing.int().argmax(1)
        a, b = d.gather(1, first[:, None])[:, 0], d.gather(1, first[:, None] + 1)[:, 0]
        zero = t[first] + (t[1] - t[0]) * a / (a - b).clamp_min(1e-9)
        found_at[part] = torch.where(crossing.any(1), zero, 0.0)
    return (found_at * cosine).view(camera.height, camera.width).numpy()


def registered_again(fields: Path) -> Iterator[str]:
    """Objects of a room, registered against it as it is and as edits left it."""
    room = "mix-room"
    scene = open_field(fields / f"{room}.safetensors")
    pairs = pairs_of(fields, "pairs.json", room)
    objects = {pair.object: open_field(fields / f"{pair.object}.safetensors") for pair in pairs}
    for number, pair in enumerate(pairs):
        obj, other = objects[pair.object], pairs[(number + 1) % len(pairs)]
        moved = _moved_to(pair, other)
        known = Substitution(objects[other.object], other.truth)
        cases = {
            "as trained": (pair, scene),
            "taken away and put back": (pair, _put(scene, pair, obj, pair)),
            f"{other.object} substituted": (pair, compose(scene, [known])),
            f"in the place of {other.object}": (moved, _put(scene, other, objects[other.object], moved, obj)),
        }
        for name, (wanted, field) in cases.items():
            one = found(wanted, field, obj)
            error = mssd(one.T_object_scene, wanted.truth, one.points, declared(pair.instance)) / wanted.diameter
            yield f"| {pair.object} | {name} | {one.verdict} | {100 * error:.2f} % |"


def _put(scene: SdfField, there: Pair, known: SdfField, pair: Pair, obj: SdfField | None = None) -> SdfField:
    """The scene without the known object of the pair ``there``, and with the object of ``pair`` put at its pose."""
    empty = compose(scene, [Removal(obj=known, T_object_scene=there.truth)])
    return compose(empty, [Insertion(known if obj is None else obj, pair.truth)])


def _moved_to(pair: Pair, place: Pair) -> Pair:
    """The pair with its object where another one stands, on the same ground."""
    low, to = (box.center - torch.tensor([0.0, 0.0, 0.5]) * box.size for box in (pair.detection, place.detection))
    detection = replace(pair.detection, center=pair.detection.center + to - low)
    return replace(pair, detection=detection, truth=pair.truth @ Sim3.from_translation(low - to))


def table(title: str, head: Sequence[str], rows: Iterator[str]) -> str:
    lines = [f"## {title}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for row in rows:
        print(row, flush=True)
        lines.append(row)
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("fields", "meshes", "rooms"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/rendering.md"))
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=("depth", "back", "frame", "again"))
    parser.add_argument("--frame-scene", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    folders = arguments.fields, arguments.meshes, arguments.rooms
    wanted = arguments.only or ("depth", "back", "frame", "again")
    parts = []
    if "depth" in wanted:
        head = ("room", "object", "verdict", "median depth error, diameters", "silhouette IoU")
        parts.append(table("A substituted object against its mesh", head, substituted(*folders, arguments.views)))
    if "back" in wanted:
        head = ("object", "verdict", "before", "after", "times smaller")
        parts.append(table("A chair of a short walk, worst side", head, unseen_back(*folders, arguments.views)))
    if "frame" in wanted:
        head = ("mode", "evaluations a pixel", "s", "processor s", "depth error, 1/1000 units")
        scene = open_field(arguments.frame_scene or arguments.fields / "mix-room.safetensors")
        parts.append(table("A frame of 320 x 240", head, frames(scene, (320, 240))))
    if "again" in wanted:
        head = ("object", "field", "verdict", "pose error")
        parts.append(table("Registered against the edited field", head, registered_again(arguments.fields)))
    arguments.output.write_text("# Rendering and editing\n\n" + "\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
