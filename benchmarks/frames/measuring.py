"""What a registration of a simulated frame finds, and what it knew: one row for each question."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from scipy.spatial import KDTree

from benchmarks.frames import scenes
from benchmarks.frames.scenes import Known, Simulated, View
from benchmarks.random_worlds.mesh import Mesh, block, together
from benchmarks.random_worlds.models import Part, families
from benchmarks.worlds.evidence import pose_rows
from benchmarks.worlds.questions import DIFFERS
from benchmarks.worlds.stages import NearestTruth, recorded
from benchmarks.worlds.stages import Recording as Kept
from regnf_core import RegistrationOptions, RegnfError, Sim3, register
from regnf_core.detections.images import ImageDetection
from regnf_core.geometry.box import OrientedBox
from regnf_core.robust import pipeline
from regnf_core.robust.constants import SEARCH
from regnf_data.recordings.recording import Frame, StoredFrame
from regnf_data.recordings.recording import Recording as Frames
from regnf_fit.images.recorded_scene import recorded_scene

Row = dict[str, Any]
Asked = Literal["right", "other", "altered", "neighbor's mask", "empty place"]
_WRONG: tuple[tuple[Asked, float], ...] = (
    ("other", 0.45), ("altered", 0.25), ("neighbor's mask", 0.2), ("empty place", 0.1)
)  # fmt: skip
_WRONG_SHARE = 0.4
"""Of the frames about which a wrong question is asked too."""
_KNOWN_WITHIN = 0.03
"""How exactly the caller knows the scale."""
_FEWEST_PIXELS = 60
_POINTS = 2500


@dataclass(frozen=True, eq=False)
class Question:
    """known: the object that is asked for · scale: meters of its unit, as the caller has it · T_object_scene: the
    truth; None where the object is not there."""

    asked: Asked
    detection: str
    detections: tuple[ImageDetection, ...]
    known: Known
    scale: float
    T_object_scene: Sim3 | None


def rows_of(folders: tuple[Path, ...], part: Part, seed: int, every_detection: bool = False) -> Iterator[Row]:
    """The rows of a seed's frames; none where the object cannot be seen. every_detection: the right object by every
    kind of detection."""
    made = scenes.simulate(folders, part, seed)
    if made.visible < 0.1 or made.facts["pixels"] < _FEWEST_PIXELS:
        return
    rng = np.random.default_rng([seed, 7])
    for question in _questions(made, scenes.library(folders, part), rng, every_detection):
        yield {**made.facts, "world": _world(made), **_answered(made, question)}


def _world(made: Simulated) -> str:
    """A name by which rows of one family of objects belong together, as those of a world do."""
    name = made.facts["object"].split("_")[0]
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
    return f"frames-{number}-{'single' if made.facts['views'] == 1 else 'few'}"


def _questions(made: Simulated, known: scenes.Library, rng: np.random.Generator, every: bool) -> Iterator[Question]:
    right = made.placed[0]
    off = 0.0 if rng.random() < 0.5 else rng.uniform(-0.02, 0.02)
    truth = Sim3.from_matrix(np.linalg.inv(right.T).tolist())
    scale = made.scale * (1.0 + off)
    second = 1 if len(made.views) > 1 and rng.random() < 0.4 and made.views[1].mask.sum() > _FEWEST_PIXELS else 0
    for name in scenes.DETECTIONS if every else (scenes.draw_detection(rng),):
        told = [scenes.detection(view, name, rng) for view in made.views[: 1 + second]]
        yield Question("right", name, tuple(told), right.known, scale, truth)
    if every or rng.random() >= _WRONG_SHARE:
        return
    asked = _WRONG[rng.choice(len(_WRONG), p=[share for _, share in _WRONG])][0]
    name = scenes.draw_detection(rng)
    if asked in ("other", "altered"):
        wrong = _altered(right.known, rng) if asked == "altered" else _other(right.known, known, rng)
        size = made.facts["longest_m"] * (1.0 if asked == "altered" else rng.uniform(0.85, 1.15))
        told = [scenes.detection(made.views[0], name, rng)]
        yield Question(asked, name, tuple(told), wrong, size / wrong.size, None)
        return
    view = made.views[0]
    mask = _neighbor(view, rng) if asked == "neighbor's mask" else _empty(view, rng)
    if mask is not None:
        elsewhere = replace(view, things=np.where(mask, 0, 1))
        yield Question(asked, name, (scenes.detection(elsewhere, name, rng),), right.known, scale, truth)


def _other(right: Known, known: scenes.Library, rng: np.random.Generator) -> Known:
    """Another object; half of the time the one of some whose shape is nearest by its signature."""
    family = families([one.name for one in (*known.small, *known.big)])
    others = [one for one in (*known.small, *known.big) if family[one.name] != family.get(right.name)]
    drawn = [others[n] for n in rng.choice(len(others), size=min(8, len(others)), replace=False)]
    if rng.random() < 0.5:
        return drawn[0]
    return min(drawn, key=lambda one: float((one.model.signature - right.model.signature).square().sum()))


def _altered(right: Known, rng: np.random.Generator) -> Known:
    """The right object longer along an axis, or with a block more."""
    mesh = right.mesh
    if rng.random() < 0.5:
        stretch = np.ones(3)
        stretch[rng.integers(3)] = rng.choice([rng.uniform(0.72, 0.85), rng.uniform(1.18, 1.4)])
        return Known(f"{right.name}, stretched", Mesh(mesh.vertices * stretch, mesh.faces))
    points, normals = mesh.sample(8, rng)
    size = rng.uniform(0.15, 0.3, 3) * right.size
    center = points[0] + 0.25 * size.min() * normals[0]
    return Known(f"{right.name}, a block more", together(mesh, block(center.tolist(), size.tolist())))


def _neighbor(view: View, rng: np.random.Generator) -> scenes.Mask | None:
    """The mask of another thing."""
    numbers, counts = np.unique(view.things[view.things > 0], return_counts=True)
    numbers = numbers[counts > 4 * _FEWEST_PIXELS]
    return None if not len(numbers) else view.things == rng.choice(numbers)


def _empty(view: View, rng: np.random.Generator) -> scenes.Mask | None:
    """A part of the background as large as the object's mask."""
    rows, columns = np.nonzero(view.mask)
    size = np.array([np.ptp(rows), np.ptp(columns)]) + 1
    for _ in range(20):
        low = (rng.uniform(0.0, 1.0, 2) * (np.array(scenes.SIZE) - size)).astype(int)
        part = np.zeros_like(view.mask)
        part[low[0] : low[0] + size[0], low[1] : low[1] + size[1]] = True
        if not (view.things[part] >= 0).any() and (view.frame.depth[part] > 0.0).mean() > 0.7:
            return part
    return None


def _stored(frame: Frame) -> StoredFrame:
    return StoredFrame(frame.name, frame.camera, frame.T_world_camera, lambda: frame.depth)


def _answered(made: Simulated, question: Question) -> Row:
    """What is found in the frames, by the way that the product goes."""
    frames = Frames("simulated", "simulated", tuple(_stored(view.frame) for view in made.views))
    known, scale = question.known, question.scale
    low, high = ((1.0 + sign * _KNOWN_WITHIN) / scale for sign in (-1.0, 1.0))
    options = RegistrationOptions.from_dict({"robust": {"object_unit": "m", "min_scale": low, "max_scale": high}})
    model = known.model
    row: Row = {
        "asked": question.asked,
        "detection": question.detection,
        "model": question.asked if question.asked != "right" else known.name,
    }
    begun = time.perf_counter()
    try:
        scene = recorded_scene(frames, question.detections, known.mesh.bounds * scale, options)
        lifted = time.perf_counter()
        row |= {"lift_s": round(lifted - begun, 3), **_of_box(made, scene.box)}
        with recorded() as kept:
            result = register(scene.field, known.field, scene.box, scene.options, object_model=model, clouds=False)
    except RegnfError as error:
        return row | {"verdict": "error", "reason": error.reason, "said": str(error)[:150], "poses": []}
    row |= {
        "register_s": round(time.perf_counter() - lifted, 3),
        "verdict": result.verdict,
        "reason": result.verdict_reason,
        "broken": result.verdict_limit,
        "probability": round(float(result.metrics["probability"]), 4),
        "T": result.T_object_scene.matrix().numpy().round(6).tolist(),
        "diameter_m": round(float(result.metrics["object_diameter"]) * scale, 4),
        "metrics": {name: round(float(value), 5) for name, value in result.metrics.items()},
    }
    return row | _poses(kept, made, question, scene.options)


def _of_box(made: Simulated, box: OrientedBox) -> Row:
    """How much of the object the lifted box holds, and how long its diagonal is, diagonals of the object's."""
    points = torch.from_numpy(made.placed[0].points)
    return {
        "box_holds": round(float(box.contains(points, 0.1).double().mean()), 3),
        "box_size": round(box.diagonal / float(np.linalg.norm(made.placed[0].known.mesh.size) * made.scale), 3),
    }


def _poses(kept: Kept, made: Simulated, question: Question, options: RegistrationOptions) -> Row:
    """Errors up to the symmetries that nearly hold."""
    problem, last, truth = kept.problem, kept.evaluations[-1], question.T_object_scene
    assert problem is not None
    problem = problem.on("cpu")
    points = torch.from_numpy(question.known.surface.surface[:_POINTS])

    def errors(T: Sim3, near: bool = True) -> list[float]:
        if truth is None:
            return [9.0] * len(T)
        found: list[float] = NearestTruth(problem, truth, points, question.known.symmetries[near]).errors(T).tolist()
        return found

    poses = pose_rows(kept.problem, last.candidates, errors(last.candidates.on("cpu").T), last.winner, options)
    winner = poses[last.winner]
    row = {"error": winner["mssd"], "listed_error": winner["listed_mssd"]}
    row |= {"error_exact": round(errors(last.candidates.on("cpu").T[last.winner][None], near=False)[0], 5)}
    row |= {"best_error": min(pose["mssd"] for pose in poses)}
    row |= {"seen_difference": 1.0 if truth is not None else round(_seen_difference(made, question, last.T), 4)}
    if truth is not None and question.asked == "right":
        start = problem.in_working_frames(truth)[None]
        refined = pipeline.refine_poses(problem, start, torch.Generator().manual_seed(0))[torch.tensor([0])]
        poses += pose_rows(problem, refined, errors(refined.on("cpu").T), None, options)
        row["truth_error"], row["truth_score"] = poses[-1]["mssd"], poses[-1]["score"]
        row |= _of_truth(problem, start)
    return row | {"poses": poses}


def _seen_difference(made: Simulated, question: Question, T: Sim3) -> float:
    """Share of both surfaces, the true one's and that of the object as it is placed, that differs and lies where an
    image shows free space or surface."""
    true = made.placed[0].points[::4]
    mine = T.inverse().apply(torch.from_numpy(question.known.surface.surface[:_POINTS:4])).numpy()
    size = float(np.linalg.norm(np.ptp(mine, axis=0)))
    far = np.concatenate([KDTree(mine).query(true)[0], KDTree(true).query(mine)[0]]) > DIFFERS * size
    places = np.concatenate([true, mine])
    seen = np.zeros(len(places), dtype=bool)
    for view in made.views:
        frame = view.frame
        local = (places - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
        column, row = np.floor(frame.camera.project(local)).astype(np.int64).T
        inside = (local[:, 2] > 0.0) & (column >= 0) & (column < frame.depth.shape[1])
        inside &= (row >= 0) & (row < frame.depth.shape[0])
        depth = frame.depth[row[inside], column[inside]]
        seen[inside] |= (depth > 0.0) & (local[inside, 2] <= depth + DIFFERS * size)
    return float((far & seen).mean())


def _of_truth(problem: Any, truth: Sim3) -> Row:
    """Whether the box admits the truth, and how much of the foreground is the object's there."""
    foreground = problem.view.foreground
    distances, _ = problem.model.distance_grid.value_and_gradient(
        truth[0].apply(foreground.on_surface().double()).float()
    )
    return {
        "truth_admitted": [
            bool(problem.bound.loosened(factor).admits(truth)[0]) for factor in (1.0, SEARCH.seed_tolerance)
        ],
        "foreground": len(foreground),
        "foreground_right": round(float((distances.abs() < 0.04).double().mean()), 3),
    }
