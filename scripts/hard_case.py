"""A hard case as a picture: an armchair on its back, five times smaller than the library's, seen from one side.

    python -m scripts.hard_case [docs/images/hard-case.png]

All that the scene's field knows is one depth image, made by looking at a room with the demo's armchair in it: what the
camera saw through is free, everything else is solid. The library's armchair is then found in it from nothing but a box.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.robust.depth_camera import looking
from benchmarks.robust.one_view_field import DepthImage, OneViewField, directions
from benchmarks.solids import BoxField, UnionField
from regnf_core import OrientedBox, RegistrationResult, Sim3, open_field, register
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.metrics import errors_against_truth, gaps
from regnf_core.surface.sphere_tracing import Rays, clip_to_region, first_hits
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR
from regnf_core.viewing.splats import Surfels, render, view_from

ROOT = Path(__file__).resolve().parents[1]
ARMCHAIR = ROOT / "examples" / "data" / "armchair.safetensors"
TARGET = ROOT / "docs" / "images" / "hard-case.png"
SCALE = 5.0
EYE = np.array([0.30, -0.33, 0.27])
"""Where the camera stands, scene units: the chair is about 0.2 across."""
PIXELS, REACH, FAR = 220, 0.27, 1.5
_PANEL, _CAPTION, _SUPERSAMPLING = 420, 56, 2
_GROUND = np.array([0.975, 0.975, 0.97])
_INK, _GRAY = (52, 56, 62), (120, 124, 130)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """What is registered, and the truth. ``image`` is all that ``scene`` was made from."""

    scene: SdfField
    image: DepthImage
    obj: SdfField
    box: OrientedBox
    truth: Sim3


def make_case() -> Case:
    """The toppled chair on a floor before a wall, looked at once."""
    obj = open_field(ARMCHAIR)
    topple = Sim3.from_quaternion(1.0, [-0.7071068, 0.0, 0.0, 0.7071068], [0.0, 0.0, 0.0])
    turn = Sim3.from_quaternion(1.0, [0.0, 0.0, 0.25, 0.97], [0.0, 0.0, 0.0])
    lying = Sim3.from_quaternion(1.0 / SCALE, [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0]) @ turn @ topple
    low, high = bounds_of_surface(obj, lying)
    T_scene_object = Sim3.from_translation(torch.tensor([0.0, 0.0, -float(low[2])]).double()) @ lying
    low, high = low - [0.0, 0.0, low[2]], high - [0.0, 0.0, low[2]]
    truth = T_scene_object.inverse()
    floor, wall = BoxField((-0.6, -0.6, -0.05), (0.6, 0.6, 0.0)), BoxField((-0.6, 0.3, 0.0), (0.6, 0.35, 0.5))
    room = UnionField([floor, wall, TransformedField(obj, truth)])
    margin = 0.03 * (high - low)
    box = OrientedBox.from_corners((low - margin).tolist(), (high + margin).tolist())
    image = depth_image(room, EYE, (low + high) / 2)
    return Case(OneViewField(image, room.bounds), image, obj, box, truth)


def bounds_of_surface(obj: SdfField, T: Sim3) -> tuple[Floats, Floats]:
    """Lowest and highest corner (3,) of the object's surface after ``T``, from points of a grid near it."""
    low, high = obj.bounds
    axes = [torch.linspace(float(a), float(b), 96) for a, b in zip(low, high, strict=True)]
    grid = torch.cartesian_prod(*axes)
    distance, gradient = obj.signed_distance_and_gradient(grid)
    near = distance.abs() < 0.02
    surface = T.apply((grid - distance[:, None] * gradient)[near].double())
    return surface.amin(0).numpy(), surface.amax(0).numpy()


def depth_image(room: SdfField, position: Floats, target: Floats) -> DepthImage:
    """What a camera sees of the room, along its axis; nothing is farther than FAR."""
    axes = looking(position, target)
    along = directions(PIXELS, REACH).reshape(-1, 3)
    unit = torch.from_numpy(along / np.linalg.norm(along, axis=-1, keepdims=True) @ axes.T).float()
    rays = Rays(torch.from_numpy(position).float().expand_as(unit), unit)
    entry, exit_ = clip_to_region(rays, *room.bounds)
    hits = first_hits(room, rays, entry, exit_, 5e-4, 1e-4)
    depth = np.full(len(along), FAR)
    depth[hits.rays.numpy()] = (hits.points.numpy() - position) @ axes[:, 2]
    return DepthImage(position, axes, REACH, depth.reshape(PIXELS, PIXELS))


def picture(case: Case, result: RegistrationResult) -> Image.Image:
    """Three panels: what the camera saw; all that is known, from behind; the library's chair laid onto it."""
    seen = cloud(result.scene_samples.points, result.scene_samples.normals, SCENE_COLOR)
    back = result.T_object_scene.inverse()
    obj = result.object_samples
    placed = cloud(back.apply(obj.points.double()), obj.normals.double() @ back.rotation.mT, OBJECT_COLOR)
    errors = errors_against_truth(result.T_object_scene, case.truth, obj.points)
    sheet = Image.new("RGB", (3 * _PANEL, _PANEL + _CAPTION), tuple(int(255 * part) for part in _GROUND))
    both = Surfels.join(seen, placed)
    panels = [shaded_depth(case.image), panel(seen, both, case), panel(both, both, case)]
    for number, one in enumerate(panels):
        sheet.paste(one, (number * _PANEL, _CAPTION))
    caption(sheet, 0, "One depth image", "an armchair on its back, seen from beneath")
    caption(sheet, 1, "What the field knows", "from the other side: solid behind what was seen")
    found = (
        f"scale {float(result.T_object_scene.scale):.3f} (true {SCALE:g}), off by {100 * errors['mssd_share']:.1f} %"
    )
    caption(sheet, 2, f"{result.verdict.capitalize()}", f"{found} of the diameter at most")
    return sheet


def cloud(points: torch.Tensor, normals: torch.Tensor, color: tuple[float, float, float]) -> Surfels:
    """Points and normals (N, 3) as discs of one color."""
    array = points.double().numpy()
    return Surfels(array, normals.double().numpy(), np.broadcast_to(np.array(color), array.shape))


def panel(discs: Surfels, framed: Surfels, case: Case) -> Image.Image:
    """The discs from behind and above, so large that ``framed`` fills the panel."""
    up = np.array([0.0, 0.0, 1.0])
    away = case.box.center.numpy() - EYE
    direction = np.array([away[0], 0.4 * away[1], 0.45 * np.linalg.norm(away)])
    edge = _PANEL * _SUPERSAMPLING
    view = view_from(direction / np.linalg.norm(direction), up, framed.points, edge)
    radius = 1.6 * float(gaps(torch.from_numpy(framed.points)).median())
    drawn = render(discs, view, edge, radius, _GROUND)
    large = Image.fromarray((255 * np.clip(drawn, 0.0, 1.0)).round().astype(np.uint8))
    return large.resize((_PANEL, _PANEL), Image.Resampling.LANCZOS)


def shaded_depth(image: DepthImage) -> Image.Image:
    """Near is bright, with a lamp beside the camera to tell the faces apart."""
    points = image.points()
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    towards = (image.position - points) / np.linalg.norm(image.position - points, axis=-1, keepdims=True)
    light = np.abs((normals * towards).sum(-1))
    near = np.clip(1.15 - image.depth / (2.0 * np.median(image.depth)), 0.2, 1.0)
    gray = np.where(image.depth < FAR, 0.25 + 0.75 * light * near, 0.97)
    picture = Image.fromarray((255 * np.clip(gray, 0.0, 1.0)).astype(np.uint8)).convert("RGB")
    return picture.resize((_PANEL, _PANEL), Image.Resampling.LANCZOS)


def caption(sheet: Image.Image, number: int, heading: str, note: str) -> None:
    draw = ImageDraw.Draw(sheet)
    draw.text((number * _PANEL + 18, 10), heading, fill=_INK, font=ImageFont.load_default(size=19))
    draw.text((number * _PANEL + 18, 34), note, fill=_GRAY, font=ImageFont.load_default(size=13))


def main() -> None:
    torch.set_num_threads(1)
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    case = make_case()
    result = register(case.scene, case.obj, case.box)
    errors = errors_against_truth(result.T_object_scene, case.truth, result.object_samples.points)
    print(result.verdict, result.verdict_reason, {name: round(value, 5) for name, value in errors.items()})
    print({name: round(value, 4) for name, value in result.metrics.items() if "share" in name or "violations" in name})
    picture(case, result).quantize(128).save(target, optimize=True)
    print(f"wrote {target}, {target.stat().st_size} bytes")


if __name__ == "__main__":
    main()
