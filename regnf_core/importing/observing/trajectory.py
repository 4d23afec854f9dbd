"""Where the cameras of a run stood, as files say it: poses and intrinsics, checked, in one convention."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import Assumptions

if TYPE_CHECKING:
    from regnf_core.geometry.pinhole import PinholeCameras

Array = npt.NDArray[np.float64]
Axes = Literal["opencv", "opengl"]
"""opencv: x right, y down, z forward. opengl: x right, y up, z backward."""
_TURNS: dict[Axes, Array] = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}
BODY: Array = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a camera to the body that holds it, whose x is forward and z up."""
MOST_CAMERAS = 20_000
_FARTHEST = 1e8
"""Geodetic coordinates reach ten million meters; poses are kept in double precision."""
_NOT_RIGID = 0.02
"""How far a pose's axes may be from unit length and from right angles."""
_FIELD_OF_VIEW = (0.05, 50.0)
"""Focal lengths over the image's size that some lens has."""


@dataclass(frozen=True)
class Intrinsics:
    """Of one camera, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """poses: (N, 4, 4), camera to the file's world, opencv · focal, middle: (N, 2), over the image's width and height ·
    aspect: (N,) · T_dataset_file: (4, 4), from the file's world to the dataset's, where they differ · axes: by which
    the file's matrices were read; None where the file itself tells the axes."""

    poses: Array
    focal: Array
    middle: Array
    aspect: Array
    T_dataset_file: Array | None = None
    axes: Axes | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def assumes(self) -> Assumptions:
        """What the file does not say of its poses."""
        frame = "poses are in the frame and unit of the field, or of its dataset where that is known"
        more = f"; camera to world, with {self.axes}'s axes; quaternions are x, y, z, w"
        return (f"cameras: {frame}{'' if self.axes is None else more}",)

    def pinhole(self) -> PinholeCameras:
        """The cameras in the file's world."""
        import torch

        from regnf_core.geometry.pinhole import PinholeCameras

        parts = (self.poses[:, :3, 3], self.poses[:, :3, :3], self.focal, self.middle, self.aspect)
        return PinholeCameras(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))

    def otherwise(self) -> Iterator[tuple[str, str, Trajectory]]:
        """Other conventions that the file may follow, the usual ones first: each what it is, what to do about it, and
        the cameras by it."""
        if self.axes is None:
            return
        stated, other = _TURNS[self.axes], _TURNS["opengl" if self.axes == "opencv" else "opencv"]
        matrices = self.poses @ stated  # a half turn undoes itself
        inverse = np.linalg.inv(matrices)
        name = "along z (OpenCV's axes)" if self.axes == "opengl" else "against z (OpenGL's axes)"
        flag = "opencv" if self.axes == "opengl" else "opengl"
        say, invert = f"give --camera-axes {flag} (import option cameras.axes)", "invert the matrices of the file"
        looking, inverted = f"cameras that look {name}", "poses from the world to the camera"
        wrong = {
            looking: (say, matrices @ other),
            inverted: (invert, inverse @ stated),
            f"{inverted} and {looking}": (f"{invert}, and {say}", inverse @ other),
            "quaternions with w first": ("write quaternions as x y z w", rolled_quaternions(matrices, -1) @ stated),
            "cameras that look along x (the body frame of a robot)": (
                "rotate the axes of the cameras: z is forward",
                matrices @ BODY,
            ),
        }
        for words, (mend, poses) in wrong.items():
            yield words, mend, replace(self, poses=poses)


def trajectory_of(
    name: str,
    poses: Array,
    intrinsics: list[Intrinsics] | Intrinsics,
    axes: Axes | None,
    T_dataset_file: Array | None = None,
) -> Trajectory:
    """Checked. poses: (N, 4, 4), by ``axes``; those with numbers that are not finite, of lost cameras, are left out.

    Raises FieldFormatError (CAMERAS_MALFORMED) naming ``name``, the file.
    """
    each = [intrinsics] * len(poses) if isinstance(intrinsics, Intrinsics) else intrinsics
    kept = np.isfinite(poses).all(axis=(1, 2))
    poses = poses[kept].copy()
    if not len(poses):
        raise malformed(f"{name} has no camera pose")
    poses = poses @ _TURNS[axes or "opencv"]
    _require_rigid(name, poses)
    K = np.array([[one.fx, one.fy, one.cx, one.cy, one.width, one.height] for one in each], np.float64)[kept]
    size = K[:, 4:6]
    with np.errstate(all="ignore"):
        focal, middle, aspect = K[:, :2] / size, K[:, 2:4] / size, size[:, 0] / size[:, 1]
    low, high = _FIELD_OF_VIEW
    sound = (size > 0).all(1) & (focal > low).all(1) & (focal < high).all(1)
    sound &= (np.abs(middle - 0.5) <= 1.0).all(1) & (aspect > 0.05) & (aspect < 20.0)
    if not sound.all():
        raise malformed(f"{name}: the intrinsics of camera {int(np.flatnonzero(~sound)[0])} are invalid")
    return Trajectory(poses, focal, middle, aspect, T_dataset_file, axes)


def rolled_quaternions(poses: Array, step: int) -> Array:
    """Poses (N, 4, 4) of quaternions x y z w whose numbers stand in another order. step: -1, they were written as
    w x y z; 1, they were taken for that."""
    from scipy.spatial.transform import Rotation

    rolled, quaternions = poses.copy(), Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rolled[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, step, axis=1)).as_matrix()
    return rolled


def _require_rigid(name: str, poses: Array) -> None:
    axes = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # numbers near the largest ones overflow, and nothing compares with NaN
        off = np.abs(axes.transpose(0, 2, 1) @ axes - np.eye(3)).max(axis=(1, 2))
        sound = (off <= _NOT_RIGID) & (np.linalg.det(axes) > 0) & (np.abs(poses[:, :3, 3]).max(axis=1) <= _FARTHEST)
        sound &= np.abs(poses[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1) <= 1e-6
    if not sound.all():
        raise malformed(f"{name}: pose {int(np.flatnonzero(~sound)[0])} is not a rotation and a translation")


def malformed(message: str) -> FieldFormatError:
    """The error for cameras that break their format."""
    return FieldFormatError(message, reason="CAMERAS_MALFORMED")


def without_intrinsics(name: str) -> FieldFormatError:
    """The error for poses whose file does not say how wide the cameras' view is."""
    message = f"{name} has no intrinsics: give the import options cameras.intrinsics [fx, fy, cx, cy] and cameras.size"
    return FieldFormatError(message, reason="CAMERAS_INTRINSICS_MISSING")
