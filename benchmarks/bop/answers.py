"""Answers to detections, the file of poses that BOP's server takes, and what is judged by the truth."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.bop.dataset import Dataset, Target, Truth, matrix_of
from benchmarks.bop.errors import MSPD_LIMITS, MSSD_LIMITS, Array, Mesh, matched, mspd, mssd, surfaces_apart
from benchmarks.bop.writing import rendered
from regnf_core.version import ENGINE_REVISION

RIGHT = 0.05
"""Diameters: a pose at which no point of the surface is farther off is right."""
_NEAR = 5.0
"""mm."""
_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclass(frozen=True)
class Answer:
    """What was said of one detection.

    verdict: registered, ambiguous, rejected, or failed where there is no pose · pose: 16 numbers, object to camera,
    mm · others: the alternatives of an ambiguous one · scale: of the object, which BOP's pose leaves out · seconds: of
    the processor, for this detection alone · number, visible: of the true object, the share of its silhouette that is
    seen.
    Errors: mssd, surface (see :func:`surfaces_apart`) in diameters, listed: the least ``surface`` of the pose and the
    others; spread: how far the others' surfaces are from that of the pose · mspd: pixels. Without a truth: explained,
    the share of the visible pixels whose measured point lies within 5 mm of the placed surface, along the axis;
    truth_explains: the same at the true pose.
    """

    scene_id: int
    im_id: int
    obj_id: int
    verdict: str
    reason: str = ""
    probability: float = 0.0
    pose: tuple[float, ...] | None = None
    others: tuple[tuple[float, ...], ...] = ()
    scale: float = 1.0
    seconds: float = 0.0
    number: int | None = None
    visible: float = float("nan")
    mssd: float = float("inf")
    mspd: float = float("inf")
    surface: float = float("inf")
    listed: float = float("inf")
    spread: float = 0.0
    explained: float = float("nan")
    truth_explains: float = float("nan")

    @property
    def matrix(self) -> Array | None:
        return None if self.pose is None else np.array(self.pose).reshape(4, 4)

    @property
    def right(self) -> bool:
        """By shape: a depth camera sees no prints."""
        return self.surface <= RIGHT


def judged(dataset: Dataset, answer: Answer) -> Answer:
    """With its errors: against the truth that its detection was made of, else the nearest of its object."""
    truths = dataset.truths(answer.scene_id, answer.im_id, answer.obj_id)
    if answer.number is not None:
        truths = [one for one in truths if one.number == answer.number]
    pose = answer.matrix
    if pose is None or not truths:
        return answer
    known, K = dataset.judged(answer.obj_id), dataset.intrinsics(answer.scene_id, answer.im_id)
    apart = [float(np.linalg.norm(one.pose[:3, 3] - pose[:3, 3])) for one in truths]
    nearest = truths[int(np.argmin(apart))]
    poses = [pose, *(np.array(each).reshape(4, 4) for each in answer.others)]
    surfaces = [surfaces_apart(each, nearest.pose, known.mesh) / known.diameter for each in poses]
    return replace(
        answer,
        visible=nearest.visible,
        mssd=mssd(pose, nearest.pose, known.corners, known.symmetries) / known.diameter,
        mspd=mspd(pose, nearest.pose, known.vertices, known.symmetries, K),
        surface=surfaces[0],
        listed=min(surfaces),
        spread=max((surfaces_apart(pose, each, known.mesh) / known.diameter for each in poses[1:]), default=0.0),
        explained=_explained(dataset, answer, nearest, pose, known.mesh),
        truth_explains=_explained(dataset, answer, nearest, nearest.pose, known.mesh),
    )


def _explained(dataset: Dataset, answer: Answer, truth: Truth, pose: Array, mesh: Mesh) -> float:
    mask = dataset.mask(answer.scene_id, answer.im_id, truth.number)
    if mask is None:
        return float("nan")
    picture = dataset.picture(answer.scene_id, answer.im_id)
    measured = mask & (picture.depth > 0.0)
    if not measured.any():
        return float("nan")
    apart = np.abs(rendered(mesh, pose, picture) - picture.depth)
    return float((apart[measured] <= _NEAR).mean())


@dataclass(frozen=True)
class Recall:
    """Average recalls over the thresholds, of all targets, and how many those are."""

    mssd: float
    mspd: float
    targets: int


def recall(dataset: Dataset, targets: Sequence[Target], answers: Iterable[Answer], width: int = 640) -> Recall:
    """By BOP's matching: of each target the best answers by probability, as many as it has instances.

    width: of the images, pixels.
    """
    given: dict[tuple[int, int, int], list[Answer]] = {}
    for answer in answers:
        if answer.pose is not None:
            given.setdefault((answer.scene_id, answer.im_id, answer.obj_id), []).append(answer)
    found = np.zeros((2, len(MSSD_LIMITS)))
    total = 0
    for target in targets:
        total += target.count
        best = sorted(given.get((target.scene_id, target.im_id, target.obj_id), ()), key=lambda one: -one.probability)
        truths = dataset.truths(target.scene_id, target.im_id, target.obj_id)
        if not best or not truths:
            continue
        known, K = dataset.judged(target.obj_id), dataset.intrinsics(target.scene_id, target.im_id)
        best = best[: target.count]
        scores = [one.probability for one in best]
        pairs = [[(one.matrix, truth.pose) for truth in truths] for one in best]
        far = [[mssd(P, T, known.corners, known.symmetries) for P, T in row if P is not None] for row in pairs]
        shown = [[mspd(P, T, known.vertices, known.symmetries, K) for P, T in row if P is not None] for row in pairs]
        for row, (errors, limits) in enumerate(
            ((far, MSSD_LIMITS * known.diameter), (shown, MSPD_LIMITS * width / 640.0))
        ):
            hits = [int(matched(np.array(errors), scores, limit).sum()) for limit in limits]
            found[row] += np.minimum(hits, target.count)
    shares = found.mean(axis=1) / max(total, 1)
    return Recall(float(shares[0]), float(shares[1]), total)


# Files.


def write_csv(path: Path, answers: Sequence[Answer]) -> None:
    """BOP's: a row a pose; R row by row, t in mm; the time is the image's, the same in all of its rows."""
    spent: dict[tuple[int, int], float] = {}
    for one in answers:
        spent[one.scene_id, one.im_id] = spent.get((one.scene_id, one.im_id), 0.0) + one.seconds
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(_COLUMNS)
        for one in answers:
            pose = one.matrix
            if pose is None:
                continue
            R, t = (" ".join(f"{value:.8g}" for value in part.ravel()) for part in (pose[:3, :3], pose[:3, 3]))
            score, time = f"{one.probability:.6f}", f"{spent[one.scene_id, one.im_id]:.3f}"
            rows.writerow((one.scene_id, one.im_id, one.obj_id, score, R, t, time))


def read_csv(path: Path) -> list[Answer]:
    """The poses of any method in BOP's form, as accepted ones."""
    answers = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            pose = matrix_of([float(x) for x in row["R"].split()], [float(x) for x in row["t"].split()])
            scene_id, im_id, obj_id = (int(row[key]) for key in _COLUMNS[:3])
            flat = tuple(pose.ravel().tolist())
            answers.append(Answer(scene_id, im_id, obj_id, "registered", "", float(row["score"]), flat))
    return answers


def read_answers(path: Path) -> list[Answer]:
    """What :func:`write_answers` wrote."""
    rows = (json.loads(line) for line in path.read_text().splitlines())
    poses = (
        {**row, "pose": row["pose"] and tuple(row["pose"]), "others": tuple(map(tuple, row["others"]))} for row in rows
    )
    return [Answer(**{key: value for key, value in row.items() if key != "revision"}) for row in poses]


def write_answers(path: Path, answers: Sequence[Answer]) -> None:
    """One JSON object a line, with the engine's revision."""
    path.write_text("".join(json.dumps({"revision": ENGINE_REVISION, **asdict(one)}) + "\n" for one in answers))
