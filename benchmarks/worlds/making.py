"""Worlds as files: a folder each with the scene's field, the objects' fields and the truth in ``world.json``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds.fusing import fuse
from benchmarks.random_worlds.mesh import Array, Mesh, together
from benchmarks.random_worlds.models import part_of_world, read_catalog
from benchmarks.random_worlds.placing import draw_box
from benchmarks.random_worlds.walks import LENGTHS, Length, World, make_world
from benchmarks.robust.library_objects import GIVEN
from benchmarks.worlds.objects import ObjectKind, ObjectMaker
from benchmarks.worlds.observing import cameras_of_walk, observation_of_walk
from benchmarks.worlds.recipe import FROM_IMAGES, RENDERED, Scene, Seen, see
from regnf_core.errors import RegnfError
from regnf_core.geometry.pinhole import PinholeCameras
from regnf_core.schema.description import ObservationGrid
from regnf_data.recordings.camera import Camera
from regnf_data.recordings.recording import Recording, StoredFrame
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.fusion import fuse_images
from regnf_fit.options import ReconstructionOptions

WORLD, SCENE, CAMERAS, FRAMES = "world.json", "scene.safetensors", "cameras.npz", "frames.npz"
MAX_CASES = 8
LEAST_SEEN: dict[Length, float] = {"long": 0.3, "short": 0.25, "single": 0.12}
"""Of an object's surface, measured in some image from its front: what was seen less is no case."""
LEAST_VOXELS = 20.0
"""Across an object: what is smaller is no case."""
_SCALES = (0.05, 20.0)
_STEP_M = 1e-4
"""Of depths as they are kept: 65535 steps are farther than any sensor's."""
_REACH = 1.9
"""Of the bounds that images are fitted in, in the units of the fit: its grid ends at 2."""
_TRAINED = (90, 450)
"""Iterations that an under-trained field is given."""


@dataclass(frozen=True)
class Task:
    """A world to make. meshes: folders of meshes · folder: where worlds are kept · objects: the kind of all objects'
    fields; None: drawn."""

    seed: int
    length: Length
    scene: Scene
    meshes: tuple[Path, ...]
    folder: Path
    objects: ObjectKind | None = None

    @property
    def home(self) -> Path:
        """The world's own folder."""
        return self.folder / f"{self.scene}-{self.seed}-{self.length}"


def make(task: Task) -> str:
    """Make the world unless it is there. Returns a line to follow the progress by."""
    if (task.home / WORLD).exists():
        return f"{task.home.name}: there"
    part = part_of_world(task.seed)
    world = make_world(task.seed, read_catalog(task.meshes, part, GIVEN))
    try:
        seen = see(world, task.length, rendered=task.scene in RENDERED)
    except RegnfError as error:
        return f"{task.home.name}: none, {error}"
    rough = task.home.with_name(f"{task.home.name}.part")
    shutil.rmtree(rough, ignore_errors=True)
    rough.mkdir(parents=True)
    written = _write(task, world, seen, rough)
    (rough / WORLD).write_text(json.dumps({"part": part, **written}, indent=1))
    rough.rename(task.home)
    return f"{task.home.name}: {world.kind}, {seen.name}, {len(written['cases'])} cases"


def _write(task: Task, world: World, seen: Seen, home: Path) -> dict[str, Any]:
    rng = np.random.default_rng([task.seed, 17, LENGTHS.index(task.length)])
    scene = _write_scene(task.scene, world, seen, home, rng)
    _write_observation(seen, home)
    _write_cameras(seen, home)
    _write_frames(seen, home)
    # As many scenes stay in their own frame as do not.
    T_scene_room = similarity(rng, (0.2, 5.0)) if rng.random() < 0.5 else np.eye(4)
    maker = ObjectMaker(world, seen, home, task.objects, LEAST_SEEN[task.length])
    chosen = _chosen(world, seen, task.length, rng)
    cases = [_case(task.scene, maker, case, number, T_scene_room, rng) for case, number in enumerate(chosen)]
    return {
        "seed": world.seed,
        "kind": world.kind,
        "length": task.length,
        "walk": seen.name,
        "scene": scene,
        "drift": seen.drift,
        "sensor": asdict(seen.taken.sensor),
        "fusion": asdict(seen.fusion),
        "T_scene_room": T_scene_room.tolist(),
        "things": [placed.model.name for placed in world.things if placed.model is not None],
        "cases": cases,
    }


def _case(
    scene: Scene, maker: ObjectMaker, case: int, number: int, T_scene_room: Array, rng: np.random.Generator
) -> dict[str, Any]:
    """What ``world.json`` says of case number ``case``, the thing of this ``number``; writes the object's field."""
    placed, seen = maker.world.things[number], maker.seen
    assert placed.model is not None
    T_object_model = similarity(rng, _SCALES)
    kind = maker.make(number, case, rng)
    T_fused_room, spread = np.eye(4), 0.0
    if scene in FROM_IMAGES:
        T_fused_room, spread = seen.taken.carried(number, placed.outside[0])
    T_fused_model = T_fused_room @ placed.T_room_model
    box = draw_box(placed.model.surface @ T_fused_model[:3, :3].T + T_fused_model[:3, 3], T_fused_model, rng)
    return {
        "name": placed.model.name,
        "field": kind,
        "seen": float((seen.taken.seen[number] > 0).mean()),
        "diameter_m": placed.model.diameter,
        "voxels_across": placed.model.diameter / seen.fusion.voxel_m,
        "drift_spread": spread / placed.model.diameter,
        "T_object_scene": (T_object_model @ np.linalg.inv(T_scene_room @ T_fused_model)).tolist(),
        "T_object_model": T_object_model.tolist(),
        "detection": {"center": box.center.tolist(), "size": box.size.tolist(), "rotation": box.rotation.tolist()},
    }


def similarity(rng: np.random.Generator, scales: Sequence[float]) -> Array:
    """(4, 4): any turn, a scale between two (small ones as often as large ones), a shift of a few units."""
    scale = float(np.exp(rng.uniform(*np.log(scales))))
    T = np.eye(4)
    T[:3, :3] = scale * Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:3, 3] = scale * rng.normal(scale=1.0, size=3)
    return T


def _chosen(world: World, seen: Seen, length: Length, rng: np.random.Generator) -> list[int]:
    """Numbers of the things to register: those seen well enough, not too small for the voxels."""
    fit = [
        number
        for number, placed in enumerate(world.things)
        if placed.model is not None
        and (seen.taken.seen[number] > 0).mean() >= LEAST_SEEN[length]
        and (placed.mesh.bounds[0] >= seen.bounds[0]).all()
        and (placed.mesh.bounds[1] <= seen.bounds[1]).all()
        and placed.model.diameter >= LEAST_VOXELS * seen.fusion.voxel_m
    ]
    return sorted(rng.permutation(fit)[:MAX_CASES].tolist())


def _write_scene(scene: Scene, world: World, seen: Seen, home: Path, rng: np.random.Generator) -> dict[str, Any]:
    if scene in ("tsdf", "rendered"):
        fuse(seen.taken, seen.fusion, seen.bounds, home / SCENE)
        return {"kind": scene}
    if scene in ("fused", "rendered-fused"):
        fuse_images(seen.taken.images(seen.bounds), home / SCENE)
        return {"kind": scene}
    if scene in FROM_IMAGES:
        options = ReconstructionOptions(observation_voxels=0)
        if scene == "under-trained":
            options = replace(options, iterations=int(rng.uniform(*_TRAINED)))
        units = min(1.0, _REACH / float(np.abs(seen.bounds).max()))
        images = seen.taken.images(seen.bounds).moved(np.zeros(3), units)
        report = reconstruct(images, FitFiles(home / SCENE), options, world.seed)
        return {"kind": scene, "iterations": report.iterations, "units_per_meter": units}
    mesh = together(*(placed.mesh for placed in world.all))
    np.savez(home / "scene.npz", vertices=mesh.vertices, faces=mesh.faces)
    if scene == "mesh":
        return {"kind": scene}
    return {
        "kind": scene,
        "amplitude": float(rng.uniform(0.001, 0.006)),
        "wavelength": float(rng.uniform(0.1, 0.6)),
        "bend_seed": int(rng.integers(2**31)),
    }


def _write_observation(seen: Seen, home: Path) -> None:
    observation = observation_of_walk(seen.taken, seen.bounds)
    grid, words = observation.stored()
    np.savez(home / "observation.npz", words=words, **{name: np.asarray(value) for name, value in asdict(grid).items()})


def read_observation_grid(home: Path) -> tuple[ObservationGrid, Any]:
    """What :func:`make` has written of the observation: the grid, and its words."""
    with np.load(home / "observation.npz") as file:
        low, counts = file["low"].tolist(), file["counts"].tolist()
        grid = ObservationGrid((low[0], low[1], low[2]), float(file["voxel"]), (counts[0], counts[1], counts[2]))
        return grid, file["words"]


def _write_cameras(seen: Seen, home: Path) -> None:
    cameras = cameras_of_walk(seen.taken)
    np.savez(home / CAMERAS, **{part.name: getattr(cameras, part.name).numpy() for part in fields(cameras)})


def read_cameras(home: Path) -> PinholeCameras:
    """Where the cameras of the walk are thought to have stood, in the world, as :func:`make` has written it."""
    with np.load(home / CAMERAS) as file:
        return PinholeCameras(**{part.name: torch.from_numpy(file[part.name]) for part in fields(PinholeCameras)})


def _write_frames(seen: Seen, home: Path) -> None:
    depths = np.round(seen.taken.depths / _STEP_M).astype(np.uint16)
    np.savez_compressed(
        home / FRAMES, depths=depths, intrinsics=seen.taken.sensor.intrinsics, T_world_camera=seen.taken.estimated
    )


def read_recording(home: Path) -> Recording:
    """The walk's frames, in the room's frame and meters, by the estimated poses."""
    with np.load(home / FRAMES) as file:
        depths, intrinsics, poses = (file[name] for name in ("depths", "intrinsics", "T_world_camera"))
    camera = Camera(intrinsics, depths.shape[1:])
    frames = [
        StoredFrame(f"{number:04d}", camera, pose, partial(_in_meters, depth))
        for number, (depth, pose) in enumerate(zip(depths, poses, strict=True))
    ]
    return Recording("walk", "walk", tuple(frames))


def _in_meters(steps: NDArray[np.uint16]) -> NDArray[np.float32]:
    return steps * np.float32(_STEP_M)


def read_object_mesh(home: Path, number: int) -> Mesh:
    """The mesh of the object of case number ``number``, in the model's frame, as :func:`make` has written it."""
    with np.load(home / f"object-{number}.npz") as file:
        return Mesh(file["vertices"], file["faces"])
