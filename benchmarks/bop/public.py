"""Data sets in BOP's layout of real frames that lie in public repositories, with what others published for them.

    python -m benchmarks.bop.public REPOSITORIES OUTPUT

REPOSITORIES holds checkouts, OWNER/NAME; what is not there is left out. Nothing of them is part of this repository:
each has a license of its own.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import sys
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from benchmarks.bop.answers import Answer, read_csv, write_csv
from benchmarks.bop.dataset import matrix_of
from benchmarks.bop.errors import Array, Mesh, outermost
from benchmarks.bop.writing import Picture, Placed, placed, write_scene
from regnf_core.importing.mesh_file import read_mesh_file

_RESULTS = "thodan/bop_toolkit/bop_toolkit_lib/tests/data/results_sub"
_MODELS = "prajwalkuhikar/megapose6d/local_data/bop_datasets/bop_models_panda3d"
_EXAMPLE = "JiehongLin/SAM-6D/SAM-6D/Data/Example"
_YCB_FRAMES = (
    # Repository and path, the keyframe of the videos 48 to 59, and its place among the video's keyframes.
    ("yuxng/PoseCNN/data/demo_images/000001-{}.png", 50, 1, 0),
    ("yuxng/PoseCNN/data/demo_images/000002-{}.png", 51, 1, 0),
    ("yuxng/PoseCNN/data/demo_images/000005-{}.png", 54, 1, 0),
    ("GeeeG/CloudPose/data/{}.png", 50, 963, 92),
    ("agimus-project/happypose_ros/happypose_ros/test/{}/000629.png", 50, 629, 48),
)
_YCB_K = np.array([[1066.778, 0.0, 312.9869], [0.0, 1067.487, 241.3109], [0.0, 0.0, 1.0]])
_YCB_NAMES = (
    *("002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle"),
    *("007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana"),
    *("019_pitcher_base", "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block"),
    *("037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick"),
)
"""Object 1 and the following."""
_POSECNN_IDS = {19: 20, 20: 21}
"""That demo knows no large clamp: its class 19 is the extra large one, its class 20 the foam brick."""
_YCB_POSES = "DLR-RM/3DObjectTracking/M3T/data/ycb-video_poses.zip"
_YCB_METHODS = ("cosypose", "posecnn_icp_rss2018", "posecnn_rss2018", "sundermeyer")


@dataclass(frozen=True)
class Models:
    """Meshes in one folder, copied there as they are found."""

    folder: Path

    def take(self, source: Path, files: Iterable[Path] = ()) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for file in (*sorted(source.glob("obj_*.ply")), source / "models_info.json", *files):
            shutil.copyfile(file, self.folder / file.name)

    def mesh(self, obj_id: int) -> Mesh:
        found = read_mesh_file(self.folder / f"obj_{obj_id:06d}.ply")
        return np.asarray(found.vertices, np.float64), np.asarray(found.faces)

    def known(self, obj_id: int) -> bool:
        return (self.folder / f"obj_{obj_id:06d}.ply").is_file()


def _picture(depth: Path, unit: float, K: Array, color: Path | None) -> Picture:
    """unit: mm a step."""
    values = np.asarray(Image.open(depth)).astype(np.float64) * unit
    return Picture(values, K, None if color is None else np.asarray(Image.open(color).convert("RGB")))


def lmo(repositories: Path, output: Path) -> None:
    """Image 3 of LM-O: eight objects on a table, a structured-light camera at 1 m. True poses and those of MegaPose."""
    example, results = repositories / _EXAMPLE, repositories / _RESULTS
    models = Models(output / "models")
    models.take(repositories / _MODELS / "lm" / "models", [example / "obj_000005.ply"])
    K = np.array(json.loads((example / "camera.json").read_text())["cam_K"], np.float64).reshape(3, 3)
    picture = _picture(example / "depth.png", 1.0, K, example / "rgb.png")
    listed = [one for one in read_csv(_one(results, "gt-*_lmo-test_*.csv")) if one.im_id == 3]
    poses = [one.matrix for one in listed if one.matrix is not None]
    ids = [one.obj_id for one in listed]
    objects = placed(picture, [models.mesh(obj_id) for obj_id in ids], ids, poses)
    write_scene(output / "test" / "000002", {3: (picture, objects)})
    theirs = [one for one in read_csv(_one(results, "cnos-fastsammegapose_lmo-*.csv")) if one.im_id == 3]
    write_csv(output / "published" / "megapose_lmo-test.csv", theirs)


def lmo_truth(repositories: Path, output: Path) -> None:
    """The true poses of all of LM-O, without images: for judging poses of others by BOP's errors."""
    lmo_models = Models(output / "models")
    lmo_models.take(repositories / _MODELS / "lm" / "models", [repositories / _EXAMPLE / "obj_000005.ply"])
    K = json.loads((repositories / _EXAMPLE / "camera.json").read_text())["cam_K"]
    truths: dict[str, list[dict[str, Any]]] = {}
    for one in read_csv(_one(repositories / _RESULTS, "gt-*_lmo-test_*.csv")):
        pose = one.matrix
        assert pose is not None
        row = {"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": pose[:3, 3].tolist(), "obj_id": one.obj_id}
        truths.setdefault(str(one.im_id), []).append(row)
    scene = output / "test" / "000002"
    scene.mkdir(parents=True, exist_ok=True)
    (scene / "scene_gt.json").write_text(json.dumps(truths))
    (scene / "scene_camera.json").write_text(json.dumps({im_id: {"cam_K": K} for im_id in truths}))
    theirs = _one(repositories / _RESULTS, "cnos-fastsammegapose_lmo-*.csv")
    (output / "published").mkdir(exist_ok=True)
    shutil.copyfile(theirs, output / "published" / "megapose_lmo-test.csv")


def ycbv(repositories: Path, output: Path) -> None:
    """Five keyframes of three YCB-Video test videos: true poses, and those of five methods; and two training frames."""
    models = Models(output / "models")
    models.take(repositories / _MODELS / "ycbv" / "models")
    shifts = [_shift(repositories, models, obj_id) for obj_id in range(1, len(_YCB_NAMES) + 1)]
    archive = zipfile.ZipFile(repositories / _YCB_POSES)
    scenes: dict[int, dict[int, tuple[Picture, Sequence[Placed]]]] = {}
    published: dict[str, list[Answer]] = {name: [] for name in _YCB_METHODS}
    for form, scene_id, im_id, place in _YCB_FRAMES:
        parts = ("depth", "rgb" if "happypose" in form else "color")
        depth, color = (repositories / form.format(part) for part in parts)
        if not depth.is_file():
            continue
        picture = _picture(depth, 0.1, _YCB_K, color)
        truth = _listed(archive, "ground_truth", scene_id, place, shifts)
        meshes = [models.mesh(obj_id) for obj_id in truth]
        scenes.setdefault(scene_id, {})[im_id] = (picture, placed(picture, meshes, list(truth), list(truth.values())))
        for name, answers in published.items():
            for obj_id, pose in _listed(archive, name, scene_id, place, shifts).items():
                answers.append(_published(scene_id, im_id, obj_id, pose))
    for number in (1, 2):
        file = repositories / "xbliuhnu/6DoF-Pose-Visualization/data" / f"{number:06d}-meta.mat"
        if file.is_file():
            scenes.setdefault(900, {})[number] = _with_meta(file, models, shifts)
    for scene_id, pictures in scenes.items():
        write_scene(output / "test" / f"{scene_id:06d}", pictures)
    images = {(scene_id, im_id) for scene_id, pictures in scenes.items() for im_id in pictures}
    theirs = read_csv(_one(repositories / _RESULTS, "cnos-fastsammegapose_ycbv-*.csv"))
    published["megapose"] = [one for one in theirs if (one.scene_id, one.im_id) in images]
    for name, answers in published.items():
        write_csv(output / "published" / f"{name.replace('_', '-')}_ycbv-test.csv", answers)


def posecnn(repositories: Path, output: Path) -> None:
    """Four frames of a stereo depth camera at 0.7 m, five objects each. There is no truth: scene_gt.json holds the
    poses that PoseCNN published, after its refinement by depth, and the masks are PoseCNN's labels."""
    models = Models(output / "models")
    models.take(repositories / _MODELS / "ycbv" / "models")
    shifts = [_shift(repositories, models, obj_id) for obj_id in range(1, len(_YCB_NAMES) + 1)]
    demo = repositories / "NVlabs/PoseCNN-PyTorch/data/demo"
    pictures: dict[int, tuple[Picture, Sequence[Placed]]] = {}
    before: list[Answer] = []
    for file in sorted((demo / "posecnn_results").glob("*.mat")):
        im_id, values = int(file.name[:6]), loadmat(file)
        picture = _picture(
            demo / f"{im_id:06d}-depth.png", 1.0, values["intrinsic_matrix"], demo / f"{im_id:06d}-color.png"
        )
        objects = []
        for row, first, refined in zip(values["rois"], values["poses"], values["poses_refined"], strict=True):
            obj_id = _POSECNN_IDS.get(int(row[1]), int(row[1]))
            objects.append(Placed(obj_id, _pose_of(refined, shifts[obj_id - 1]), values["labels"] == int(row[1])))
            before.append(_published(1, im_id, obj_id, _pose_of(first, shifts[obj_id - 1])))
        pictures[im_id] = (picture, objects)
    write_scene(output / "test" / "000001", pictures)
    write_csv(output / "published" / "posecnn_posecnn-test.csv", before)


def tyol(repositories: Path, output: Path) -> None:
    """One frame of TYO-L: a thing of 0.34 m on a table, a depth camera at 0.7 m, its true pose."""
    data = repositories / "m-pabst/surface-matching/data"
    models = Models(output / "models")
    models.folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(data / "obj.ply", models.folder / "obj_000019.ply")
    corners = outermost(models.mesh(19)[0])
    diameter = np.linalg.norm(corners[:, None] - corners[None], axis=2).max()
    (models.folder / "models_info.json").write_text(json.dumps({"19": {"diameter": float(diameter)}}))
    camera, (truth,) = (json.loads((data / f"scene_{name}.json").read_text())["10"] for name in ("camera", "gt"))
    K = np.array(camera["cam_K"], np.float64).reshape(3, 3)
    picture = _picture(data / "depth" / "000010.png", 1.0, K, data / "rgb" / "000010.png")
    pose = matrix_of(truth["cam_R_m2c"], truth["cam_t_m2c"])
    write_scene(output / "test" / "000019", {10: (picture, placed(picture, [models.mesh(19)], [19], [pose]))})


SETS: dict[str, Callable[[Path, Path], None]] = {
    "lmo": lmo,
    "lmo_truth": lmo_truth,
    "ycbv": ycbv,
    "tyol": tyol,
    "posecnn": posecnn,
}


# What they share.


def _one(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if not found:
        raise FileNotFoundError(f"{folder} has no {pattern}")
    return found[0]


def _published(scene_id: int, im_id: int, obj_id: int, pose: Array) -> Answer:
    return Answer(scene_id, im_id, obj_id, "registered", "", 1.0, tuple(pose.ravel().tolist()))


def _shift(repositories: Path, models: Models, obj_id: int) -> Array:
    """(3,) mm: from BOP's frame of a YCB object to the data set's own; BOP moved its origin into the middle."""
    if not models.known(obj_id):
        return np.zeros(3)
    points = np.loadtxt(repositories / "yuxng/PoseCNN/data/LOV/models" / _YCB_NAMES[obj_id - 1] / "points.xyz")
    middles = [(each.min(axis=0) + each.max(axis=0)) / 2.0 for each in (1000.0 * points, models.mesh(obj_id)[0])]
    return np.asarray(middles[0] - middles[1])


def _pose_of(row: Array, shift: Array) -> Array:
    """(4, 4) mm in BOP's frame, of a quaternion (w first) and meters in the data set's own."""
    rotation = Rotation.from_quat(np.array(row[:4], np.float64), scalar_first=True).as_matrix()
    return matrix_of(rotation.ravel().tolist(), 1000.0 * np.array(row[4:7], np.float64) + rotation @ shift)


def _listed(archive: zipfile.ZipFile, method: str, scene_id: int, place: int, shifts: list[Array]) -> dict[int, Array]:
    """The poses of one keyframe, by object; a row of zeros stands for none."""
    found = {}
    for name in archive.namelist():
        start = f"poses/{method}/{scene_id:04d}_"
        if name.startswith(start):
            obj_id = _YCB_NAMES.index(name.removeprefix(start).removesuffix(".txt")) + 1
            row = np.loadtxt(io.BytesIO(archive.read(name)))[place]
            if np.linalg.norm(row[:4]) > 0.5:
                row = np.concatenate([row[:4] / np.linalg.norm(row[:4]), row[4:]])
                found[obj_id] = _pose_of(row, shifts[obj_id - 1])
    return dict(sorted(found.items()))


def _with_meta(file: Path, models: Models, shifts: list[Array]) -> tuple[Picture, Sequence[Placed]]:
    """A frame as YCB-Video has it: poses in meta.mat, masks in label.png."""
    values = loadmat(file)
    start = str(file).removesuffix("meta.mat")
    picture = _picture(Path(f"{start}depth.png"), 0.1, values["intrinsic_matrix"], Path(f"{start}color.png"))
    label = np.asarray(Image.open(f"{start}label.png"))
    ids = [int(one) for one in values["cls_indexes"].ravel()]
    poses = []
    for number, obj_id in enumerate(ids):
        R, t = values["poses"][:, :3, number], values["poses"][:, 3, number]
        poses.append(matrix_of(R.ravel().tolist(), 1000.0 * t + R @ shifts[obj_id - 1]))
    found = placed(picture, [models.mesh(obj_id) for obj_id in ids], ids, poses)
    return picture, [Placed(one.obj_id, one.pose, label == one.obj_id, one.silhouette) for one in found]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bop.public", description=__doc__.split("\n")[0])
    parser.add_argument("repositories", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--only", nargs="*", choices=SETS, default=list(SETS))
    asked = parser.parse_args(arguments)
    missing = 0
    for name in asked.only:
        try:
            SETS[name](asked.repositories, asked.output / name)
            print(f"{name}: {SETS[name].__doc__.split('.')[0]}")
        except FileNotFoundError as error:
            print(f"{name} is left out: {error}", file=sys.stderr)
            missing += 1
    return 0 if missing < len(asked.only) else 2


if __name__ == "__main__":
    sys.exit(main())
