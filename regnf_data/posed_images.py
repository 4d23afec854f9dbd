"""Images of one scene with their cameras, whatever they were read from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from regnf_core.geometry.box import OrientedBox


@dataclass(frozen=True)
class Instance:
    """An instance in the scene, as a detector would name it.

    box: in the world frame · label: its class or name · T_object_world: (4, 4) float64 from world to the library
    object, the truth if the dataset has it · world_pose, gt_pose: (4, 4), the instance's own frame to the world and to
    the metric frame, as the dataset has them; nothing is computed from these.
    """

    label: str
    box: OrientedBox
    T_object_world: NDArray[np.float64] | None = None
    world_pose: NDArray[np.float64] | None = None
    gt_pose: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Terms:
    """What the files of a layout call the objects that a convention is about.

    poses, intrinsics, unit: where they are stated · to_camera: whether poses lead from the world to the camera ·
    axes: of the cameras, by --camera-axes.
    """

    poses: str = "the poses"
    intrinsics: str = "the intrinsics"
    unit: str = ""
    to_camera: bool = False
    axes: str = "opencv"


NO_TERMS = Terms()


@dataclass(frozen=True)
class PosedImages:
    """N images of H x W pixels of one scene that stands still.

    The world frame is the one the field is fitted in; its unit is the field's. Cameras look along +z, x to the right, y
    down (OpenCV). A pixel's center lies at (column + 0.5, row + 0.5).
    """

    colors: NDArray[np.uint8]
    """(N, H, W, 3), sRGB."""
    intrinsics: NDArray[np.float64]
    """(N, 3, 3), pixels."""
    T_world_camera: NDArray[np.float64]
    """(N, 4, 4), camera to world."""
    bounds: NDArray[np.float64]
    """(2, 3): lowest and highest corner of the region worth a field, world frame."""
    depths: NDArray[np.float32] | None = None
    """(N, H, W): distance along the camera's z axis, world units; 0 where the sensor saw nothing."""
    masks: NDArray[np.bool_] | None = None
    """(N, H, W): true on the object, false on background that the field shall keep free."""
    instances: tuple[Instance, ...] = ()
    T_metric_world: NDArray[np.float64] | None = None
    """(4, 4): world to the metric frame (sdfstudio's ``worldtogt``), if known."""
    terms: Terms = NO_TERMS

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.colors.shape[1], self.colors.shape[2]

    def __len__(self) -> int:
        return len(self.colors)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N, H, W): where there is a depth, and no mask says background."""
        measured = np.zeros(self.colors.shape[:3], np.bool_) if self.depths is None else self.depths > 0.0
        return measured if self.masks is None else measured & self.masks

    @property
    def T_world_pixel(self) -> NDArray[np.float64]:
        """(N, 3, 3): from (column + 0.5, row + 0.5, 1) to its ray in the world, whose part along the camera's axis is
        1."""
        return self.T_world_camera[:, :3, :3] @ np.linalg.inv(self.intrinsics)

    def rays(
        self, image: NDArray[np.int64], row: NDArray[np.int64], column: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origins and directions (R, 3) of the rays of pixels (R,), world frame: as long as one unit of depth."""
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=-1)
        return self.T_world_camera[image, :3, 3], np.einsum("rij,rj->ri", self.T_world_pixel[image], pixels)

    def ends(self, image: int) -> NDArray[np.float64]:
        """(H, W, 3): where one image's depths end, world frame; the camera's place where there is none."""
        assert self.depths is not None
        rows, columns = np.indices(self.size) + 0.5
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(self.intrinsics[image]).T
        T = self.T_world_camera[image]
        ends: NDArray[np.float64] = (self.depths[image][..., None] * rays) @ T[:3, :3].T + T[:3, 3]
        return ends

    def moved(self, origin: NDArray[np.float64], scale: float) -> PosedImages:
        """The same images in the world x' = scale (x - origin). origin: (3,), world frame."""
        poses, T_world_local = self.T_world_camera.copy(), np.diag([1.0 / scale] * 3 + [1.0])
        poses[:, :3, 3] = scale * (poses[:, :3, 3] - origin)
        T_world_local[:3, 3] = origin

        def box(one: OrientedBox) -> OrientedBox:
            return replace(one, center=scale * (one.center - one.center.new_tensor(origin)), size=scale * one.size)

        def of_local(T: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            return None if T is None else T @ T_world_local

        things = (replace(t, box=box(t.box), T_object_world=of_local(t.T_object_world)) for t in self.instances)
        return replace(
            self,
            T_world_camera=poses,
            bounds=scale * (self.bounds - origin),
            depths=None if self.depths is None else (scale * self.depths).astype(np.float32),
            instances=tuple(things),
            T_metric_world=of_local(self.T_metric_world),
        )
