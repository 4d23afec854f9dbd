"""Frames of one world: read one at a time, chosen by what they add, taken together as posed images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from regnf_core.detections.images import place_of_frame
from regnf_core.errors import DatasetError
from regnf_core.importing.recording_description import RecordingDescription
from regnf_data.agreement import check_views
from regnf_data.posed_images import NO_TERMS, PosedImages, Terms
from regnf_data.recordings.camera import HALF_A_PIXEL, Array, Camera, Size, camera_of_values
from regnf_data.sdfstudio import ARRAYS, array_file, decoded, opened_image, read_depth, read_mask

MOST_FRAMES = 100_000
MOST_PIXELS = 1 << 25
"""Of one image."""
_FARTHEST = 1e6
"""Camera positions beyond are no meters."""
_NOT_RIGID = 0.02
_MILLIMETER, _EIGHT_BITS = 0.001, 255.5
_FAR, _NO_DEPTH = 100.0, 1e6
"""Meters: what depth cameras see is nearer; numbers that renderers write for nothing are beyond."""
_FEW = 4
"""Different depths of an image that shows but a wall."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image and its camera, without a lens; and the color image as it was taken.

    depth: (H, W) float32, meters along the camera's axis, 0 where nothing was measured · camera: of the depth image ·
    T_world_camera: (4, 4), OpenCV's axes · color: (H', W', 3) uint8 as it was taken, by ``color_camera`` from the same
    place · mask: (H', W') of the same size as the color, or as the depth without color: true on the object.
    """

    name: str
    depth: NDArray[np.float32]
    camera: Camera
    T_world_camera: Array
    color: NDArray[np.uint8] | None = None
    color_camera: Camera | None = None
    taken: Camera | None = None
    """The depth image's camera with its lens, where that was undone."""

    def registered(self, image: NDArray[Any]) -> NDArray[Any]:
        """An image (H', W', ...) in the pixels of the color image, or of the depth image as it was taken, in those of
        the depth image: (H, W, ...).

        Both cameras look from the same place; pixels that the color's camera did not see are 0.
        """
        of_color = self.color is not None and image.shape[:2] == self.color.shape[:2]
        source = (self.color_camera if of_color else self.taken) or self.camera
        alike = source is self.camera or (source.lens == "none" and np.array_equal(source.K, self.camera.K))
        if image.shape[:2] == self.depth.shape and alike:
            return image
        height, width = self.depth.shape
        rows, columns = np.indices((height, width)) + 0.5
        found = source.project(self.camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)))
        column, row = np.floor(found).astype(np.int64).T
        inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
        out = np.zeros((height * width, *image.shape[2:]), image.dtype)
        out[inside] = image[row[inside], column[inside]]
        return out.reshape(height, width, *image.shape[2:])

    def without_lens(self) -> Frame:
        """With the color image as a camera without a lens would have taken it."""
        if self.color is None or self.color_camera is None:
            return self
        camera, color = _without_lens(self.color_camera, self.color)
        return replace(self, color=color, color_camera=camera)

    def points(self) -> tuple[Array, NDArray[np.bool_]]:
        """World points (P, 3) of the measured pixels, and which those are: (H, W)."""
        measured = self.depth > 0.0
        rows, columns = np.nonzero(measured)
        rays = self.camera.rays(np.stack([columns + 0.5, rows + 0.5], axis=1))
        local = rays * self.depth[measured][:, None]
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3], measured


@dataclass(frozen=True, eq=False)
class StoredFrame:
    """A frame that was not read yet. depth, color: decode the image, the former to meters along the axis (or along the
    ray), of any size that has the shape of the camera's."""

    name: str
    camera: Camera
    T_world_camera: Array
    depth: Callable[[], NDArray[np.float32]]
    color: Callable[[], NDArray[np.uint8]] | None = None
    color_camera: Camera | None = None
    along_ray: bool = False
    taken: Camera | None = None
    """As of :class:`Frame`, where the lens was undone before."""

    def read(self, color: bool = True) -> Frame:
        """Raises DatasetError (DATASET_IMAGE_INVALID, DATASET_INTRINSICS_INVALID, ...) naming the frame."""
        depth = self.depth()
        size, given = (depth.shape[0], depth.shape[1]), self.camera
        if given.size is None and self.color is not None and not given.is_central(size):
            # Phones and ROS drivers give the color's intrinsics beside a smaller depth image.
            height, width = self.color().shape[:2]
            given = given.of_size((height, width), self.name) if given.is_central((height, width)) else given
        with_lens = given.of_size(size, self.name).check(self.name)
        camera, depth = _without_lens(with_lens, depth)
        if self.along_ray:
            rows, columns = np.indices(depth.shape) + 0.5
            rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
            depth = (depth / np.linalg.norm(rays, axis=1).reshape(depth.shape)).astype(np.float32)
        taken = self.taken if with_lens.lens == "none" else with_lens
        frame = Frame(self.name, depth, camera, self.T_world_camera, taken=taken)
        if not color or self.color is None:
            return frame
        picture = self.color()
        colored = (self.color_camera or with_lens).of_size((picture.shape[0], picture.shape[1]), self.name)
        return replace(frame, color=picture, color_camera=colored.check(self.name))


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames whose poses share a world, in the order of their recording.

    name: of the folder or file · layout: what it is, in its users' words · notes: what the reader took for granted ·
    T_metric_world: (4, 4), to the frame in meters, where the layout has one · is_metric: whether the world's unit is
    the meter, as far as files can tell · terms: what the layout's files call objects.
    """

    name: str
    layout: str
    frames: tuple[StoredFrame, ...]
    notes: tuple[str, ...] = ()
    T_metric_world: Array | None = None
    is_metric: bool = True
    terms: Terms = NO_TERMS

    def __len__(self) -> int:
        return len(self.frames)

    def index(self, name: str | int) -> int:
        """The place of the frame of a name, with or without its ending, or of a number.

        Raises DatasetError (DATASET_FRAMES_INVALID).
        """
        names, wanted = [frame.name for frame in self.frames], str(name)
        if (place := place_of_frame(names, wanted)) is not None:
            return place
        if len(self) == 1 and (isinstance(name, int) or Path(wanted).suffix):  # as detectors number and name images
            return 0
        near = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        raise DatasetError(f"{self.name} has no frame {wanted[:80]!r}; it has {near}", reason="DATASET_FRAMES_INVALID")

    def posed_images(self, chosen: Sequence[int], bounds: Array) -> PosedImages:
        """The chosen frames as images of one size, the most common among them. bounds: (2, 3), world."""
        frames: list[Frame] = []
        for index in chosen:  # a color image may be far larger than its depth image: one is held at a time
            frame = self.frames[index].read()
            frames.append(frame if frame.color is None else replace(frame, color=frame.registered(frame.color)))
        return replace(as_posed_images(frames, bounds, self.terms), T_metric_world=self.T_metric_world)


def as_posed_images(frames: Sequence[Frame], bounds: Array, terms: Terms = NO_TERMS) -> PosedImages:
    """Frames as images of one size, the most common among them; gray where a frame has no color of that size. bounds:
    (2, 3), world."""
    shapes = [frame.depth.shape for frame in frames]
    shape = max(set(shapes), key=shapes.count)
    frames = [frame for frame in frames if frame.depth.shape == shape]
    gray = np.full((*shape, 3), 128, np.uint8)
    colors = [gray if one.color is None or one.color.shape[:2] != shape else one.color for one in frames]
    return PosedImages(
        colors=np.stack(colors),
        intrinsics=np.stack([frame.camera.K for frame in frames]),
        T_world_camera=np.stack([frame.T_world_camera for frame in frames]),
        bounds=bounds,
        depths=np.stack([frame.depth for frame in frames]),
        terms=terms,
    )


_FRAMES, _ACROSS = 32, 200
"""Of a recording that are compared, and pixels of them across."""
_OFFSETS = 0.0, 1.0 / 16.0, 0.25, 0.5
"""Where frames are taken of each part of a recording: some follow each other closely, whatever its length."""


def check_recording(recording: Recording) -> str | None:
    """As :func:`regnf_data.agreement.check_agreement`, of some frames of a recording, in the words of its layout.

    Frames are read. Raises DatasetError as their readers do, too.
    """
    count = len(recording)
    parts = _FRAMES // len(_OFFSETS)
    spread = {int((part + offset) * count / parts) for part in range(parts) for offset in _OFFSETS}
    if count < 2:
        return None
    chosen = sorted(spread) if count > _FRAMES else range(count)
    views = [_smaller(recording.frames[index].read(color=False)) for index in chosen]
    shape = Counter(depth.shape for depth, _, _ in views).most_common(1)[0][0]
    depths, intrinsics, poses = zip(*(view for view in views if view[0].shape == shape), strict=True)
    return check_views(np.stack(depths), np.stack(intrinsics), np.stack(poses), recording.terms)


def _smaller(frame: Frame) -> tuple[NDArray[np.float32], Array, Array]:
    """Depth, intrinsics and pose of every so many pixels: the center of the first one stays where it is."""
    step = max(1, frame.depth.shape[1] // _ACROSS)
    shift = 0.5 - 0.5 / step
    intrinsics = np.array([[1.0 / step, 0.0, shift], [0.0, 1.0 / step, shift], [0.0, 0.0, 1.0]]) @ frame.camera.K
    return frame.depth[::step, ::step].copy(), intrinsics, frame.T_world_camera


@dataclass(frozen=True, eq=False)
class Given:
    """What a person says where a layout does not, or says it wrongly.

    camera: of the depth images · depth_unit: meters a step of them · layout: by its name in ``LAYOUTS`` · axes: of the
    cameras, opencv look along z, opengl against it.
    """

    camera: Camera | None = None
    depth_unit: float | None = None
    layout: str | None = None
    axes: Literal["opencv", "opengl"] | None = None

    @classmethod
    def of(cls, said: RecordingDescription) -> Given:
        """Raises DatasetError (DATASET_INTRINSICS_INVALID)."""
        found = None if said.intrinsics is None else camera_of_values(said.intrinsics, "intrinsics")
        if found is None and said.intrinsics is not None:
            raise DatasetError("the import options have no intrinsics", reason="DATASET_INTRINSICS_INVALID")
        unit = said.depth_unit or (found.depth_unit if found else None)
        return cls(found.camera if found else None, unit, said.layout, said.camera_axes)

    def described(self) -> RecordingDescription:
        """The same in plain values."""
        camera, said = self.camera, None
        if camera is not None:
            said = {"K": (camera.K - HALF_A_PIXEL).tolist(), "model": camera.lens, "D": list(camera.distortion)}
            said |= {} if camera.size is None else {"height": camera.size[0], "width": camera.size[1]}
        return RecordingDescription(self.depth_unit, self.layout, self.axes, said)


def _without_lens(camera: Camera, image: NDArray[Any]) -> tuple[Camera, NDArray[Any]]:
    ideal, found = camera.undistorted()
    if found is None:
        return ideal, image
    rows, columns, inside = found
    taken = image[rows, columns]
    taken[~inside] = 0
    return ideal, taken


# What readers of layouts share.


@dataclass(frozen=True)
class DepthFile:
    """Reads a depth image: whole numbers of ``unit`` meters, or numbers in meters where the file has a point; in that
    unit where they would be no meters. unit None: all numbers are world units."""

    path: Path
    unit: float | None

    def __call__(self) -> NDArray[np.float32]:
        path, unit, size = self.path, self.unit, checked_size(self.path)
        if unit is None:
            return read_depth(path, size, None)
        if not whole_numbers(path):
            depth = read_depth(path, size, 1.0)
            depth[depth >= _NO_DEPTH] = 0.0
            return depth * np.float32(unit) if no_meters(depth) else depth
        depth = read_depth(path, size, unit) * np.float32(unit if path.suffix.lower() in ARRAYS else 1.0)
        some = np.round(depth[::4, ::4] / unit)
        spread = next((by for by in (256, 257) if not (some % by).any() and len(np.unique(some)) > _FEW), None)
        if unit <= _MILLIMETER and (spread or 0.0 < depth.max() <= _EIGHT_BITS * unit):
            which = f"multiples of {spread}" if spread else f"whole numbers up to {round(depth.max() / unit)}"
            raise DatasetError(
                f"{path.name}: its depths are {which}: it has only 8 bits", reason="DATASET_IMAGE_INVALID"
            )
        return depth

    def notes(self) -> list[str]:
        """What is taken for granted of this file's numbers."""
        if self.unit is None or whole_numbers(self.path):
            return []
        if not no_meters(read_depth(self.path, checked_size(self.path), 1.0)):
            return []
        return [f"{self.path.name}: its depths are too large for meters: steps of {self.unit:g} m are assumed"]


def no_meters(depth: NDArray[np.float32]) -> bool:
    """Whether most depths, of those that are some, would be farther than depth cameras see."""
    some = depth[(depth > 0.0) & (depth < _NO_DEPTH)]
    return some.size > 0 and float(np.median(some)) > _FAR


def color_file(path: Path) -> Callable[[], NDArray[np.uint8]]:
    """Reads a color image."""
    return lambda: np.asarray(decoded(path, checked_size(path), "RGB"), dtype=np.uint8)


def mask_file(path: Path) -> NDArray[np.bool_]:
    """(H, W): the mask of an image file of any size."""
    return read_mask(path, checked_size(path))


def checked_size(path: Path) -> Size:
    """The size by the file's header. Raises DatasetError (DATASET_IMAGE_INVALID, DATASET_TOO_LARGE)."""
    if path.suffix.lower() in ARRAYS:
        shape = tuple(side for side in array_file(path).shape if side != 1)
        if len(shape) != 2:
            raise DatasetError(f"{path.name} is not an image with one channel", reason="DATASET_IMAGE_INVALID")
        size = (int(shape[0]), int(shape[1]))
    else:
        with opened_image(path) as image:
            size = image.height, image.width
    if size[0] * size[1] > MOST_PIXELS:
        raise DatasetError(f"{path.name} has {size[1]} x {size[0]} pixels", reason="DATASET_TOO_LARGE")
    return size


def whole_numbers(path: Path) -> bool:
    if path.suffix.lower() in ARRAYS:
        return bool(array_file(path).dtype.kind in "iu")
    with opened_image(path) as image:
        return bool(image.mode != "F")


def pose_of(matrix: Any, name: str, inverse: bool = False, unit: float = 1.0) -> Array | None:
    """A camera's pose (4, 4), to the world, of a matrix as files have it: three or four rows; None where the camera was
    lost. inverse: the matrix leads from the world to the camera · unit: meters of its translation's unit.

    Raises DatasetError (DATASET_POSE_NOT_RIGID), naming ``name``, the frame.
    """
    try:
        given = np.array(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{name}: the pose is not numbers", reason="DATASET_POSE_NOT_RIGID") from error
    if given.size in (12, 16) and max(given.shape) == given.size:
        given = given.reshape(-1, 4)
    if given.shape not in ((4, 4), (3, 4)):
        raise DatasetError(f"{name}: the pose is not 4 x 4 numbers", reason="DATASET_POSE_NOT_RIGID")
    if not np.isfinite(given).all():
        return None
    pose: Array = np.eye(4)
    pose[:3] = given[:3]
    rotation = pose[:3, :3]
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < _NOT_RIGID:
        scale = np.cbrt(abs(np.linalg.det(rotation)))
        hint = f": its axes have the length {scale:.3g}" if abs(scale - 1.0) > _NOT_RIGID else ""
        raise DatasetError(
            f"{name}: the pose is not a rotation and a translation{hint}", reason="DATASET_POSE_NOT_RIGID"
        )
    if np.linalg.det(rotation) < 0.0:
        raise DatasetError(f"{name}: the pose is a reflection (its determinant is -1)", reason="DATASET_POSE_NOT_RIGID")
    if given.shape == (4, 4) and not np.allclose(given[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        if np.allclose(given[:3, 3], 0.0):
            raise DatasetError(
                f"{name}: the pose is transposed: its last row has the translation", reason="DATASET_POSE_NOT_RIGID"
            )
        raise DatasetError(f"{name}: the pose's last row is not 0 0 0 1", reason="DATASET_POSE_NOT_RIGID")
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt
    pose[:3, 3] *= unit
    if inverse:
        pose = np.asarray(np.linalg.inv(pose), np.float64)
    if np.abs(pose[:3, 3]).max() > _FARTHEST:
        raise DatasetError(
            f"{name}: the camera is {np.abs(pose[:3, 3]).max():.3g} m from the origin", reason="DATASET_POSE_NOT_RIGID"
        )
    return pose


def recording_of(
    name: str,
    layout: str,
    frames: Sequence[StoredFrame | None],
    notes: Sequence[str] = (),
    T_metric_world: Array | None = None,
    is_metric: bool = True,
) -> Recording:
    """The recording of the frames that have a pose; what was left out is noted.

    Raises DatasetError (DATASET_NO_FRAMES) where there is none.
    """
    found = tuple(frame for frame in frames if frame is not None)
    if not found:
        raise DatasetError(
            f"{name}: no frame has depth and a pose of finite numbers ({layout})", reason="DATASET_NO_FRAMES"
        )
    if len(found) > MOST_FRAMES:
        raise DatasetError(f"{name}: {len(found)} frames; at most {MOST_FRAMES}", reason="DATASET_TOO_LARGE")
    lost = len(frames) - len(found)
    told = (f"{lost} of {len(frames)} frames have no pose or no depth and are left out",) if lost else ()
    return Recording(name, layout, found, (*notes, *told), T_metric_world, is_metric)
