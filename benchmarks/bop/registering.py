"""Objects of a data set registered in single frames: by regnf's own path from a recording, or by RANSAC and ICP."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from benchmarks.bop.answers import Answer
from benchmarks.bop.dataset import Dataset, Detections, Target
from benchmarks.bop.errors import Array
from benchmarks.peers.interface import PeerCase
from benchmarks.peers.open3d_peers import RansacIcp
from benchmarks.symmetric_errors import Symmetries
from regnf_core import RegistrationOptions, RegistrationResult, SdfField, Sim3, open_field, register
from regnf_core.detections.images import ImageDetection
from regnf_core.errors import InitializationError, RegnfError
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.library import model_object
from regnf_core.options import RobustOptions
from regnf_core.robust.model import ObjectModel
from regnf_data.recordings.detection import lift
from regnf_data.recordings.opening import open_recording
from regnf_data.recordings.recording import Recording
from regnf_fit.images.recorded_scene import recorded_scene

METHODS = ("regnf", "ransac_icp")
_MILLIMETERS = RegistrationOptions(robust=RobustOptions(object_unit="mm"))
_VOXELS, _AGREES = (0.08, 0.16, 0.25), 5.0
"""Of RANSAC: root mean square radii of the object; mm."""
_NORMAL_NEIGHBORS = 30
_NO_POSE = Answer(0, 0, 0, "failed")


@dataclass(frozen=True, eq=False)
class Known:
    """An object, read and sampled once. bounds: (2, 3), mm."""

    field: SdfField
    model: ObjectModel
    bounds: Array
    diameter: float

    @classmethod
    def of(cls, dataset: Dataset, obj_id: int) -> Known:
        field = open_field(dataset.object_file(obj_id))
        return cls(field, model_object(field), field.bounds.double().numpy(), dataset.judged(obj_id).diameter)


def register_all(
    dataset: Dataset, targets: Sequence[Target], detections: Detections, method: str = "regnf", seed: int = 0
) -> Iterator[Answer]:
    """An answer a detection; one that was refused has the verdict `failed` and says why."""
    one_by: dict[str, Callable[[Recording, ImageDetection, Known, int], Answer]] = {
        "regnf": _regnf,
        "ransac_icp": _ransac_icp,
    }
    known: dict[int, Known] = {}
    scenes: dict[int, Recording] = {}
    for target in targets:
        if target.scene_id not in scenes:
            scenes = {target.scene_id: open_recording(dataset.scene(target.scene_id))}
        if target.obj_id not in known:
            known[target.obj_id] = Known.of(dataset, target.obj_id)
        recording = scenes[target.scene_id]
        frame = replace(recording, frames=(recording.frames[recording.index(f"{target.im_id:06d}")],))
        for detection, truth in detections.of(dataset, target):
            begun = time.process_time()
            try:
                answer = one_by[method](frame, detection, known[target.obj_id], seed)
            except RegnfError as error:
                answer = replace(_NO_POSE, reason=f"{error.reason}: {error}"[:200])
            yield replace(
                answer,
                scene_id=target.scene_id,
                im_id=target.im_id,
                obj_id=target.obj_id,
                seconds=time.process_time() - begun,
                number=None if truth is None else truth.number,
                visible=float("nan") if truth is None else truth.visible,
            )


def _regnf(frame: Recording, detection: ImageDetection, known: Known, seed: int) -> Answer:
    scene = recorded_scene(frame, [detection], known.bounds, _MILLIMETERS)
    found = register(scene.field, known.field, scene.box, scene.options, seed, object_model=known.model, clouds=False)
    result = replace(found, camera=scene.camera)
    poses = [one.T_object_scene.inverse() for one in result.alternatives]
    camera = scene.camera.T_world_camera.inverse()
    return Answer(
        0,
        0,
        0,
        result.verdict,
        result.verdict_reason,
        result.probability or 0.0,
        _rigid(camera @ result.T_scene_object, result),
        tuple(_rigid(camera @ each, result) for each in poses),
        1000.0 * float(result.T_scene_object.scale),
    )


def _rigid(T_camera_object: Sim3, result: RegistrationResult) -> tuple[float, ...]:
    """16 numbers, mm to mm: without the scale, with the object's center where it was found."""
    center = result.center_object
    place = T_camera_object.apply(center[None])[0] * 1000.0
    pose = np.eye(4)
    pose[:3, :3] = T_camera_object.rotation.numpy()
    pose[:3, 3] = (place - T_camera_object.rotation @ center).numpy()
    return tuple(pose.ravel().tolist())


def _ransac_icp(frame: Recording, detection: ImageDetection, known: Known, seed: int) -> Answer:
    """Open3D's on the lifted points, at the known scale; of three sizes of voxels the pose that most points agree
    with."""
    lifted = lift(frame.frames[0].read(), detection, 0.001 * known.diameter)
    points = torch.from_numpy(1000.0 * lifted.points)
    work, samples = known.model.frame, known.model.samples
    obj = SurfaceSamples(work.out_of(samples.points), samples.normals.double())
    spread = float((obj.points - obj.points.mean(0)).square().sum(-1).mean().sqrt())
    best = Answer(0, 0, 0, "failed", "NO_INITIAL_TRANSFORM")
    for voxel in _VOXELS:
        scene = _with_normals(points.numpy(), 0.5 * voxel * spread)
        field, nowhere = known.field, Sim3.identity()
        given = PeerCase("", field, field, lifted.box, nowhere, Symmetries(), 0.0, scene, obj, 0.0, 0)
        try:
            T = RansacIcp(normalized=False, scaled=False, voxel=voxel).register(given, seed).T_object_scene
        except InitializationError:
            continue
        assert T is not None
        agreeing = float((known.field.signed_distance(T.apply(points).float()).abs() <= _AGREES).double().mean())
        if agreeing > best.probability:
            flat = tuple(T.inverse().matrix().flatten().tolist())
            best = Answer(0, 0, 0, "registered", f"{100.0 * agreeing:.0f} % agree", agreeing, flat)
    return best


def _with_normals(points: Array, voxel: float) -> SurfaceSamples:
    """Points (P, 3) seen from the origin, one a voxel; normals of the planes through their neighbors, towards it, as in
    Open3D's own tutorial of global registration."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(2.0 * voxel, _NORMAL_NEIGHBORS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    found = (torch.from_numpy(np.asarray(part).copy()) for part in (cloud.points, cloud.normals))
    return SurfaceSamples(*found)
