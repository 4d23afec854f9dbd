"""Pictures of hard cases on fields fitted to images: what was measured, what was invented, what was found.

    python -m benchmarks.image_pictures FIELDS [--output imperfect-fields.png]

FIELDS is the folder of benchmarks.make_image_fields. A row for each case: the field's surface in the detection box,
what no depth supports in red; the object laid onto what was measured, or where it should have been laid.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from benchmarks.robust.cases import Pair, load_pairs
from benchmarks.symmetric_errors import errors_against_truth
from regnf_core import RegistrationResult, Sim3, register
from regnf_core.fields.observation import observation_of
from regnf_core.geometry.metrics import gaps
from regnf_core.robust.working_frame import WorkingFrame, sample_scene_surface
from regnf_core.schema.description import SURFACE
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR
from regnf_core.viewing.splats import Surfels, render, view_from

Floats = NDArray[np.float64]

_INVENTED = np.array([0.85, 0.30, 0.22])
_GROUND = np.array([0.975, 0.975, 0.97])
_INK, _GRAY = (52, 56, 62), (120, 124, 130)
_PANEL, _CAPTION, _SUPERSAMPLING, _SAMPLES = 360, 50, 2, 60_000
_FROM = np.array([0.9, -1.2, 0.8])


@dataclass(frozen=True)
class Shown:
    """A row: the list of pairs, the case's name in it, what it is an example of."""

    pairs: str
    case: str
    title: str


ROWS = (
    Shown("pairs-single.json", "ac-room-single-fc fc", "One bad view"),
    Shown("pairs-short.json", "ac-room-short c", "A short walk"),
    Shown("pairs-after-3-percent.json", "mix-room-after-3-percent dc", "3 % of the training"),
    Shown("pairs-after-1-percent.json", "atbl-room-after-1-percent wt", "1 % of the training"),
)


def row(pair: Pair, title: str) -> Image.Image:
    """Three panels: the field's surface, what was measured of it, the object laid onto that."""
    case = pair.case()
    assert case.truth is not None
    result = register(case.scene, case.obj, case.detection, seed=0)
    surface, frame = _surface(pair)
    measured = _measured(pair, surface)
    placed = _placed(result, result.T_object_scene if result.verdict != "rejected" else case.truth, frame)
    seen = _cloud(surface, measured, SCENE_COLOR)
    framed = Surfels.join(_cloud(surface, np.ones_like(measured), SCENE_COLOR), placed)
    everything = Surfels.join(seen, _cloud(surface, ~measured, _INVENTED))
    error = errors_against_truth(result.T_object_scene, case.truth, result.object_samples.points, case.symmetries)
    found = f"{result.verdict}, off by {100 * error['mssd_share']:.1f} % at most"
    if result.verdict == "rejected":
        found = f"rejected ({result.verdict_reason}); shown at its true pose"
    sheet = Image.new("RGB", (3 * _PANEL, _PANEL + _CAPTION), tuple(int(255 * part) for part in _GROUND))
    parts = ((everything, title, "the field; red: no depth was measured"), (seen, pair.instance, "what was measured"))
    for number, (discs, heading, note) in enumerate((*parts, (Surfels.join(seen, placed), "Found", found))):
        sheet.paste(_panel(discs, framed), (number * _PANEL, _CAPTION))
        _caption(sheet, number, heading, note)
    return sheet


def _surface(pair: Pair) -> tuple[Floats, WorkingFrame]:
    """Points and normals (N, 6) of the scene in the box, working frame."""
    generator = torch.Generator().manual_seed(0)
    sampled = sample_scene_surface(pair.case().scene, pair.detection, _SAMPLES, generator)
    samples = sampled.samples
    return torch.cat([samples.on_surface(), samples.normals], 1).double().numpy(), sampled.frame


def _measured(pair: Pair, surface: Floats) -> NDArray[np.bool_]:
    seen = observation_of(pair.case().scene)
    assert seen is not None
    frame = WorkingFrame(pair.detection.center.double(), pair.detection.diagonal)
    states = seen.seen_in(frame.to_field()).at(torch.from_numpy(surface[:, :3]))
    measured: NDArray[np.bool_] = (states == SURFACE).numpy()
    return measured


def _placed(result: RegistrationResult, T_object_scene: Sim3, frame: WorkingFrame) -> Surfels:
    """The object's surface where ``T_object_scene`` lays it, working frame."""
    T = frame.to_field().inverse() @ T_object_scene.inverse()
    obj = result.object_samples
    points, normals = T.apply(obj.points.double()), obj.normals.double() @ T.rotation.mT
    return Surfels(points.numpy(), normals.numpy(), np.broadcast_to(np.array(OBJECT_COLOR), points.shape))


def _cloud(surface: Floats, chosen: NDArray[np.bool_], color: Floats | tuple[float, ...]) -> Surfels:
    points = surface[chosen.astype(bool)]
    return Surfels(points[:, :3], points[:, 3:], np.broadcast_to(np.array(color), (len(points), 3)))


def _panel(discs: Surfels, framed: Surfels) -> Image.Image:
    edge = _PANEL * _SUPERSAMPLING
    view = view_from(_FROM / np.linalg.norm(_FROM), np.array([0.0, 0.0, 1.0]), framed.points, edge)
    radius = 1.6 * float(gaps(torch.from_numpy(framed.points)).median())
    drawn = render(discs, view, edge, radius, _GROUND)
    large = Image.fromarray((255 * np.clip(drawn, 0.0, 1.0)).round().astype(np.uint8))
    return large.resize((_PANEL, _PANEL), Image.Resampling.LANCZOS)


def _caption(sheet: Image.Image, number: int, heading: str, note: str) -> None:
    draw = ImageDraw.Draw(sheet)
    draw.text((number * _PANEL + 14, 8), heading, fill=_INK, font=ImageFont.load_default(size=17))
    draw.text((number * _PANEL + 14, 29), note, fill=_GRAY, font=ImageFont.load_default(size=12))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--output", type=Path, default=Path("imperfect-fields.png"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for shown in ROWS:
        pair = next(pair for pair in load_pairs(arguments.fields, shown.pairs) if pair.name == shown.case)
        rows.append(row(pair, shown.title))
    sheet = Image.new("RGB", (rows[0].width, sum(one.height for one in rows)))
    for number, one in enumerate(rows):
        sheet.paste(one, (0, number * one.height))
    sheet.quantize(128).save(arguments.output, optimize=True)


if __name__ == "__main__":
    main()
