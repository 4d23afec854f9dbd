"""Pictures of the registrations that went most wrong: the truth on the left, what was found on the right."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from benchmarks.random_worlds.mesh import Array
from benchmarks.robust.judging import SUCCESS
from benchmarks.worlds.cases import WorldCase, cases_of
from benchmarks.worlds.making import WORLD
from benchmarks.worlds.running import Run, Way
from regnf_core import RegnfError, Sim3, register
from regnf_core.robust.working_frame import sample_scene_surface

_PANEL = 340
"""Pixels along a panel's edge."""
_TITLE = 18
_COLUMNS = 2
_SAMPLES = 40_000
_RISE = 0.5
"""Of the line of sight above the horizon, radians."""
_TRUE, _FOUND = (40, 160, 70), (215, 60, 50)


def worst_of(runs: Sequence[Run], count: int) -> list[Run]:
    """The answers about right objects that list no right pose, those with the highest probability first.

    runs: what `register` wrote, or `evidence`.
    """
    runs = [_of_evidence(run) if "question" in run else run for run in runs]
    wrong = [run for run in runs if "metrics" in run and min(run["listed_mssd"], run["mssd_share"]) > SUCCESS]
    return sorted(wrong, key=lambda run: -float(run["metrics"]["probability"]))[:count]


def _of_evidence(row: Run) -> Run:
    """A row of `evidence` as a run of `register`; without metrics where it is no answer about the right object."""
    if row["question"] != "right" or not (row["winner"] and row["found"]):
        return {}
    told = {"metrics": {"probability": row["probability"]}, "mssd_share": row["mssd"]}
    return {"seed": 0, "known_scale": None, **row, **told}


def picture_of(runs: Sequence[Run], folder: Path) -> Image.Image:
    """All runs, each registered again with its seed. folder: of the worlds."""
    tiles = [_tile(run, folder) for run in runs]
    width, height = 2 * _PANEL, _PANEL + _TITLE
    sheet = Image.new("RGB", (_COLUMNS * width, math.ceil(len(tiles) / _COLUMNS) * height), "white")
    for number, tile in enumerate(tiles):
        sheet.paste(tile, ((number % _COLUMNS) * width, (number // _COLUMNS) * height))
    return sheet


def _tile(run: Run, folder: Path) -> Image.Image:
    home = folder / str(run["world"])
    known = list(cases_of(home, run["observed_by"]))[int(run["case"])]
    truth = known.case.truth
    assert truth is not None
    options = Way(known_scale=run["known_scale"]).options(truth)
    found: Sim3 | None = None
    try:
        result = register(known.case.scene, known.case.obj, known.case.detection, options, run["seed"], clouds=False)
        found = result.T_object_scene
    except RegnfError:
        pass
    world: dict[str, Any] = json.loads((home / WORLD).read_text())
    to_room = Sim3.from_matrix(world["T_scene_room"]).inverse()
    points, normals = _scene(known, to_room)
    view = View.of(points, normals)
    tile = Image.new("RGB", (2 * _PANEL, _PANEL + _TITLE), "white")
    for number, (pose, color) in enumerate(((truth, _TRUE), (found, _FOUND))):
        placed = (
            np.zeros((0, 3)) if pose is None else to_room.apply(pose.inverse().apply(known.points.double())).numpy()
        )
        tile.paste(view.panel(points, normals, placed, color), (number * _PANEL, _TITLE))
    said = f"{run['object']} ({run['field']}), {run['kind']}, {run['length']}: {run['verdict']}"
    off = f"p {run['metrics']['probability']:.2f}, {100 * run['mssd_share']:.0f} % off"
    ImageDraw.Draw(tile).text((4, 3), f"{said}, {off}", fill="black")
    return tile


def _scene(known: WorldCase, to_room: Sim3) -> tuple[Array, Array]:
    """The scene's surface in the box, as the engine samples it: points and normals (N, 3), room frame."""
    generator = torch.Generator().manual_seed(0)
    sampled = sample_scene_surface(known.case.scene, known.case.detection, _SAMPLES, generator)
    places = to_room.apply(sampled.frame.out_of(sampled.samples.on_surface()))
    return places.numpy(), (sampled.samples.normals.double() @ to_room.rotation.mT).numpy()


class View:
    """An orthographic view. axes: (3, 3) right, up and towards the viewer, columns."""

    def __init__(self, axes: Array, center: Array, reach: float) -> None:
        self._axes, self._center, self._reach = axes, center, reach

    @classmethod
    def of(cls, points: Array, normals: Array) -> View:
        """From the side that most of the surface faces, from above."""
        azimuth = math.atan2(float(normals[:, 1].mean()), float(normals[:, 0].mean()))
        back = np.array([math.cos(azimuth) * math.cos(_RISE), math.sin(azimuth) * math.cos(_RISE), math.sin(_RISE)])
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        center = (points.min(axis=0) + points.max(axis=0)) / 2.0
        reach = 0.55 * float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
        return cls(np.stack([right, np.cross(back, right), back], axis=1), center, reach)

    def panel(self, points: Array, normals: Array, placed: Array, color: tuple[int, int, int]) -> Image.Image:
        """The surface in gray, the object's points in the color, the nearest on top."""
        shade = 0.35 + 0.6 * np.abs(normals @ self._axes[:, 2])
        local = (placed - self._center) @ self._axes
        depth = np.clip(0.75 + 0.5 * local[:, 2] / self._reach, 0.4, 1.0)
        where = np.concatenate([(points - self._center) @ self._axes, local])
        colors = np.concatenate([230.0 * shade[:, None] * np.ones(3), depth[:, None] * np.array(color)])
        image = np.full((_PANEL, _PANEL, 3), 255, np.uint8)
        order = np.argsort(where[:, 2])
        column, row = ((where[order, :2] * (1.0, -1.0) / self._reach + 1.0) * _PANEL / 2.0).astype(int).T
        for down in (0, 1):
            for aside in (0, 1):
                x, y = column + aside, row + down
                shown = (x >= 0) & (x < _PANEL) & (y >= 0) & (y < _PANEL)
                image[y[shown], x[shown]] = colors[order][shown].astype(np.uint8)
        return Image.fromarray(image)
