"""A folder in BOP's layout: its objects, targets, true poses and detections.

DATASET/models[_eval]/obj_NNNNNN.ply, models_info.json      millimeters
DATASET/SPLIT/NNNNNN/scene_camera.json, scene_gt.json, [scene_gt_info.json], rgb | gray/, depth/, [mask_visib/]
DATASET/[test_targets_bop19.json]
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.bop.errors import Array, Mesh, outermost, symmetries_of
from benchmarks.bop.writing import Picture
from regnf_core.detections.images import ImageDetection
from regnf_core.errors import DatasetError
from regnf_core.importing.mesh_file import read_mesh_file
from regnf_data.recordings.recording import mask_file

LEAST_VISIBLE = 0.1
"""A target shows so much of its silhouette at least."""
_ENDINGS = (".ply", ".obj", ".stl", ".glb")


@dataclass(frozen=True)
class Judged:
    """An object for judging. mesh: mm · corners: (C, 3) of its hull · symmetries: (S, 4, 4) ·
    diameter: mm."""

    mesh: Mesh
    corners: Array
    symmetries: Array
    diameter: float

    @property
    def vertices(self) -> Array:
        return self.mesh[0]


@dataclass(frozen=True, eq=False)
class Truth:
    """One object in one image. number: its place in the image's list · pose: (4, 4), object to camera, mm · visible:
    the share of its silhouette that is not hidden, NaN where it is not known."""

    number: int
    obj_id: int
    pose: Array
    visible: float
    box: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class Target:
    """count: how many of the object are to be found in the image."""

    scene_id: int
    im_id: int
    obj_id: int
    count: int


@dataclass(frozen=True)
class Dataset:
    """folder: of the data set · split: of its scenes · models: folder of the meshes that are registered."""

    folder: Path
    split: str
    models: Path

    @classmethod
    def of(cls, folder: Path, split: str | None = None, models: Path | None = None) -> Dataset:
        """Raises DatasetError where there are neither scenes nor models."""
        splits = [split] if split else ["test", *(f"test_{camera}" for camera in ("primesense", "kinect", "canon"))]
        found = next((one for one in splits if (folder / one).is_dir()), None)
        if found is None:
            raise DatasetError(f"{folder} has no folder {' or '.join(splits)} with scenes", hint="Give --split.")
        named = [models] if models else [folder / name for name in ("models", "models_cad", "models_eval")]
        meshes = next((one for one in named if (one / "models_info.json").is_file()), None)
        if meshes is None:
            raise DatasetError(f"{folder} has no models with models_info.json", hint="Give --models.")
        return cls(folder, found, meshes)

    def scene(self, scene_id: int) -> Path:
        return self.folder / self.split / f"{scene_id:06d}"

    @cached_property
    def scene_ids(self) -> tuple[int, ...]:
        found = (self.folder / self.split).iterdir()
        return tuple(sorted(int(one.name) for one in found if one.name.isdigit()))

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        """Those of test_targets_bop19.json; without it, all of which a tenth is visible."""
        listed = self.folder / "test_targets_bop19.json"
        if listed.is_file():
            rows = json.loads(listed.read_text())
            return tuple(
                Target(*(int(row[key]) for key in ("scene_id", "im_id", "obj_id", "inst_count"))) for row in rows
            )
        found: list[Target] = []
        for scene_id in self.scene_ids:
            for im_id in map(int, self._read(scene_id, "scene_gt.json")):
                truths = self.truths(scene_id, im_id)
                wanted = [one.obj_id for one in truths if not one.visible < LEAST_VISIBLE]
                found += [Target(scene_id, im_id, obj_id, wanted.count(obj_id)) for obj_id in sorted(set(wanted))]
        return tuple(found)

    def truths(self, scene_id: int, im_id: int, obj_id: int | None = None) -> list[Truth]:
        """The true poses in an image, of one object or all."""
        rows = self._read(scene_id, "scene_gt.json").get(str(im_id), [])
        infos = self._read(scene_id, "scene_gt_info.json").get(str(im_id), [{}] * len(rows))
        out = []
        for number, (row, info) in enumerate(zip(rows, infos, strict=True)):
            if obj_id is not None and int(row["obj_id"]) != obj_id:
                continue
            pose = matrix_of(row["cam_R_m2c"], row["cam_t_m2c"])
            left, top, width, height = info.get("bbox_visib", (0, 0, 0, 0))
            box = (left, top, left + width, top + height) if width > 0 and height > 0 else None
            out.append(Truth(number, int(row["obj_id"]), pose, float(info.get("visib_fract", np.nan)), box))
        return out

    def intrinsics(self, scene_id: int, im_id: int) -> Array:
        """(3, 3): a pixel's center at whole numbers."""
        return np.array(self._read(scene_id, "scene_camera.json")[str(im_id)]["cam_K"], np.float64).reshape(3, 3)

    def picture(self, scene_id: int, im_id: int) -> Picture:
        """Its depth, mm, without the color."""
        step = float(self._read(scene_id, "scene_camera.json")[str(im_id)].get("depth_scale", 1.0))
        files = [self.scene(scene_id) / "depth" / f"{im_id:06d}{ending}" for ending in (".png", ".tif")]
        values = np.asarray(Image.open(next(file for file in files if file.is_file())))
        return Picture(values.astype(np.float64) * step, self.intrinsics(scene_id, im_id))

    def mask(self, scene_id: int, im_id: int, number: int) -> NDArray[np.bool_] | None:
        """(H, W): what is visible of the true object of a number; None where it is not given."""
        file = self.scene(scene_id) / "mask_visib" / f"{im_id:06d}_{number:06d}.png"
        return mask_file(file) if file.is_file() else None

    def object_file(self, obj_id: int) -> Path:
        """Raises DatasetError where there is none."""
        files = [self.models / f"obj_{obj_id:06d}{ending}" for ending in _ENDINGS]
        found = next((file for file in files if file.is_file()), None)
        if found is None:
            raise DatasetError(f"{self.models} has no {files[0].name}")
        return found

    def judged(self, obj_id: int) -> Judged:
        """By the vertices of models_eval where there are some, else of the model."""
        if obj_id not in self._judged:
            folder = self.folder / "models_eval"
            used = folder if (folder / f"obj_{obj_id:06d}.ply").is_file() else self.models
            info = json.loads((used / "models_info.json").read_text())[str(obj_id)]
            mesh = read_mesh_file(used / f"obj_{obj_id:06d}.ply" if used == folder else self.object_file(obj_id))
            vertices = np.asarray(mesh.vertices, np.float64)
            symmetries = symmetries_of(info, vertices)
            self._judged[obj_id] = Judged(
                (vertices, np.asarray(mesh.faces)), outermost(vertices), symmetries, float(info["diameter"])
            )
        return self._judged[obj_id]

    @cached_property
    def _judged(self) -> dict[int, Judged]:
        return {}

    @cached_property
    def _files(self) -> dict[Path, Mapping[str, Any]]:
        return {}

    def _read(self, scene_id: int, name: str) -> Mapping[str, Any]:
        file = self.scene(scene_id) / name
        if file not in self._files:
            self._files[file] = json.loads(file.read_text()) if file.is_file() else {}
        return self._files[file]


def matrix_of(rotation: Sequence[float], translation: Sequence[float]) -> Array:
    """(4, 4) of nine and three numbers."""
    pose = np.eye(4)
    pose[:3, :3] = np.array(rotation, np.float64).reshape(3, 3)
    pose[:3, 3] = translation
    return pose


# Detections.


@dataclass(frozen=True, eq=False)
class Detections:
    """Where a target is looked for. file: rows of a detector in BOP's form, by image; None: the true masks ·
    boxes: the true visible boxes in place of masks."""

    file: Mapping[tuple[int, int], Sequence[Mapping[str, Any]]] | None = None
    boxes: bool = False

    @classmethod
    def read(cls, path: Path) -> Detections:
        """BOP's: scene_id, image_id, category_id, bbox (left, top, width, height), score, [segmentation]."""
        found: dict[tuple[int, int], list[Mapping[str, Any]]] = {}
        for row in json.loads(path.read_text()):
            found.setdefault((int(row["scene_id"]), int(row["image_id"])), []).append(row)
        return cls(found)

    def of(self, dataset: Dataset, target: Target) -> Iterator[tuple[ImageDetection, Truth | None]]:
        """Those of one target, a detector's best first, with the object that each was made of where it is known."""
        frame = f"{target.im_id:06d}"
        if self.file is not None:
            rows = [
                row
                for row in self.file.get((target.scene_id, target.im_id), ())
                if int(row["category_id"]) == target.obj_id
            ]
            for row in sorted(rows, key=lambda row: -float(row["score"]))[: target.count]:
                yield _detector(row, frame), None
            return
        truths = dataset.truths(target.scene_id, target.im_id, target.obj_id)
        shown = [one for one in truths if not one.visible < LEAST_VISIBLE]
        for truth in shown or truths:
            mask = None if self.boxes else dataset.mask(target.scene_id, target.im_id, truth.number)
            if mask is not None and mask.any():
                yield ImageDetection(frame, mask=mask), truth
            elif truth.box is not None:
                yield ImageDetection(frame, box_2d=truth.box), truth


def _detector(row: Mapping[str, Any], frame: str) -> ImageDetection:
    score = float(row["score"])
    if row.get("segmentation"):
        return ImageDetection(frame, mask=row["segmentation"], score=score)
    left, top, width, height = (float(one) for one in row["bbox"])
    return ImageDetection(frame, box_2d=(left, top, left + width, top + height), score=score)
