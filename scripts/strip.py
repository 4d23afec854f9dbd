"""The README's picture: a room with the detection box, the library's object, and the object found in the room.

    python -m scripts.strip [docs/images/strip.png]

The room has exact walls, a table, and the example's two chairs at 0.8 of their size. The preset is the default.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

import regnf
from benchmarks.solids import BoxField, UnionField
from regnf_core import Camera, OrientedBox, RenderOptions, Sim3, Substitution, compose, open_field, render
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import SdfField
from regnf_core.rendering.camera import Frame

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "examples" / "data"
TARGET = ROOT / "docs" / "images" / "strip.png"
PANEL, CAPTION = (480, 380), 62
_SCALE = 0.8
_EYE, _LOOK_AT = [0.62, -1.32, 0.84], [0.07, 0.10, 0.21]
_OBJECT_EYE = [0.80, -1.62, 0.84]
_TINT = (0.95, 0.58, 0.20)
_INK, _GRAY, _BOX = (52, 56, 62), (105, 109, 115), (205, 35, 45)
_EDGES = [(0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7)]
_LEGS = [(0.42, 0.18), (0.86, 0.18), (0.42, 0.50), (0.86, 0.50)]


def standing(obj: SdfField, x: float, y: float, turn_z: float) -> tuple[Sim3, OrientedBox]:
    """The pose of an object on the floor, turned by a quaternion (0, 0, turn_z, 1), and a box around it."""
    grid = torch.cartesian_prod(*[torch.linspace(*edge, 96) for edge in obj.bounds.T.tolist()])
    matter = grid[obj.signed_distance(grid) < 0.0].double()
    turned = Sim3.from_quaternion(_SCALE, [0.0, 0.0, turn_z, 1.0], [0.0, 0.0, 0.0])
    to_floor = Sim3.from_translation(torch.tensor([x, y, -float(turned.apply(matter)[:, 2].min())]).double())
    T_scene_object = to_floor @ turned
    low, high = _SCALE * (matter.amin(0) - 0.03), _SCALE * (matter.amax(0) + 0.03)
    low[2] += _SCALE * 0.03 + 0.004  # on the floor
    center = T_scene_object.apply((low + high)[None] / (2.0 * _SCALE))[0]
    return T_scene_object, OrientedBox(center, high - low, T_scene_object.rotation)


def furnished(chair: SdfField, T_scene_chair: Sim3) -> SdfField:
    other = open_field(DATA / "dining-chair.safetensors")
    beside, _ = standing(other, 0.30, 0.55, 0.35)
    solids: list[SdfField] = [
        BoxField((-0.9, -1.4, -0.05), (1.2, 0.9, 0.0)),
        BoxField((-0.9, 0.85, 0.0), (1.2, 0.9, 1.1)),
        BoxField((-0.9, -1.4, 0.0), (-0.85, 0.85, 1.1)),
        BoxField((0.38, 0.14, 0.30), (0.90, 0.54, 0.33)),
        *(BoxField((x - 0.02, y - 0.02, 0.0), (x + 0.02, y + 0.02, 0.30)) for x, y in _LEGS),
        TransformedField(other, beside.inverse()),
        TransformedField(chair, T_scene_chair.inverse()),
    ]
    return UnionField(solids)


def draw_box(picture: Image.Image, frame: Frame, box: OrientedBox) -> None:
    """The visible parts of the box's edges."""
    camera, draw, corners = frame.camera, ImageDraw.Draw(picture), box.corners()
    along = torch.linspace(0.0, 1.0, 240, dtype=torch.float64)[:, None]
    for one, other in _EDGES:
        local = (corners[one] + along * (corners[other] - corners[one]) - camera.position) @ camera.axes
        pixels = local[:, :2] / local[:, 2:] * torch.tensor(camera.focal) + torch.tensor(camera.middle)
        for (u, v), depth in zip(pixels.tolist(), local[:, 2].tolist(), strict=True):
            if depth < frame.depth[int(v), int(u)] + 0.01:
                draw.ellipse((u - 1.2, v - 1.2, u + 1.2, v + 1.2), fill=_BOX)


def main() -> None:
    torch.set_num_threads(1)
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    chair = open_field(DATA / "armchair.safetensors")
    T_scene_chair, box = standing(chair, -0.12, 0.0, 0.15)
    room = furnished(chair, T_scene_chair)
    result = regnf.register(room, chair, box)
    print(result)
    edited = compose(room, [Substitution(chair, result.T_object_scene, tint=_TINT)])
    inside = Camera.look_at(_EYE, _LOOK_AT, PANEL, 46.0)
    beside = Camera.look_at(_OBJECT_EYE, [0.0, 0.0, 0.0], PANEL, 38.0)
    views = ((room, inside), (chair, beside), (edited, inside))
    frames = [render(field, camera, RenderOptions(antialias=2)) for field, camera in views]
    notes = [
        ("Scene", "a room, and a rough box around the chair"),
        ("Object", "the library's chair, at its own scale"),
        (result.verdict.capitalize(), f"probability {result.probability:.3f}, scale {result.scale:.3f}"),
    ]
    sheet = Image.new("RGB", (3 * PANEL[0], PANEL[1] + CAPTION), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for number, (frame, (heading, note)) in enumerate(zip(frames, notes, strict=True)):
        picture = Image.fromarray(frame.color)
        if number == 0:
            draw_box(picture, frame, box)
        sheet.paste(picture, (number * PANEL[0], CAPTION))
        draw.text((number * PANEL[0] + 16, 8), heading, fill=_INK, font=ImageFont.load_default(size=22))
        draw.text((number * PANEL[0] + 16, 36), note, fill=_GRAY, font=ImageFont.load_default(size=15))
    sheet.save(target, optimize=True)
    print(f"wrote {target}, {target.stat().st_size} bytes")


if __name__ == "__main__":
    main()
