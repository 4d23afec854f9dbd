"""A camera's intrinsics and lens, and the files that state them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_core.texts import decode_text

Array = NDArray[np.float64]
Size = tuple[int, int]
"""Height and width, pixels."""
Lens = Literal["none", "brown", "fisheye", "inverse"]
"""none: a pinhole · brown: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 · fisheye: OpenCV's four, of the angle from the axis ·
inverse: RealSense's, brown's formula from slopes behind the lens to those before it."""

HALF_A_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Added to intrinsics of writers that take pixel centers to lie at whole numbers."""
_INVALID = "DATASET_INTRINSICS_INVALID"
_MOST_BYTES = 1 << 20
_FOCAL = 0.05, 50.0
"""Focal lengths over the image's width that some lens has."""
_OFF_MIDDLE = 0.9
"""Of half of an image: intrinsics of images twice as large have their principal point at the border, give or take."""
_CENTRAL = 0.25
"""Of half of an image's side: how far its principal point may be from its middle."""
_UNITS_M = 1e-5, 0.01
"""Meters that a step of a depth image may stand for."""
_NAMED_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_LEAST_PIXELS = 4.0
"""Of focal lengths and of the principal point: smaller ones are no pixels."""
_ROUNDS = 8
"""Of the fixed-point inversion that checks a lens: enough for lenses whose image folds nowhere."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole behind a lens. Pixel centers lie at (column + 0.5, row + 0.5).

    K: (3, 3), pixels · size: height and width of the images that K is of; None where nobody said ·
    distortion: the lens's coefficients, in OpenCV's order.
    """

    K: Array
    size: Size | None = None
    lens: Lens = "none"
    distortion: tuple[float, ...] = ()

    def of_size(self, size: Size, name: str) -> Camera:
        """The same camera for images of another resolution. name: of the frame, for the message.

        Raises DatasetError (DATASET_INTRINSICS_INVALID) where the sides' ratios differ, as for swapped sides.
        """
        if self.size is None or self.size == size:
            return replace(self, size=size)
        down, across = size[0] / self.size[0], size[1] / self.size[1]
        if abs(math.log(down / across)) > 0.02:
            turned = "check whether width and height are swapped" if self.size == size[::-1] else "not the same shape"
            raise DatasetError(
                f"{name}: the image has {size[1]} x {size[0]} pixels (width x height), its camera"
                f" {self.size[1]} x {self.size[0]}: {turned}",
                reason=_INVALID,
            )
        return replace(self, K=np.diag([across, down, 1.0]) @ self.K, size=size)

    def off_middle(self, size: Size) -> float:
        """How far the principal point lies from the middle of images of a size: 1 at their border."""
        return float(np.abs(2.0 * self.K[:2, 2] / size[::-1] - 1.0).max())

    def is_central(self, size: Size) -> bool:
        """Whether the principal point is near the middle of images of this size, as lenses are mounted."""
        return self.off_middle(size) <= _CENTRAL

    def rays(self, pixels: Array) -> Array:
        """(P, 3): directions through image points (P, 2) of a camera without a lens; their z is 1."""
        slopes = (pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        return np.concatenate([slopes, np.ones((len(pixels), 1))], axis=1)

    def project(self, points: Array) -> Array:
        """(P, 2): image points of points (P, 3) before the camera, the lens included."""
        slopes = self._bent(points[:, :2] / points[:, 2:])
        return slopes * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def undistorted(self) -> tuple[Camera, tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]] | None]:
        """The pinhole of the same K, and where each of its pixels is found: rows, columns and whether there is one.

        None for a camera without a lens. Each pixel is the nearest one: depths must not be mixed across edges.
        """
        if self.lens == "none" or self.size is None:
            return self, None
        height, width = self.size
        rows, columns = np.indices(self.size) + 0.5
        ideal = replace(self, lens="none", distortion=())
        found = self.project(ideal.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)))
        with np.errstate(invalid="ignore"):
            column, row = np.floor(found).T
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = (np.where(inside, value, 0).astype(np.int64).reshape(self.size) for value in (row, column))
        return ideal, (*index, inside.reshape(self.size))

    def check(self, name: str) -> Camera:
        """This camera. Raises DatasetError (DATASET_INTRINSICS_INVALID, DATASET_CAMERA_UNSUPPORTED) with ``name``."""
        K = self.K
        if not np.isfinite(K).all():
            raise DatasetError(f"{name}: the intrinsics are not finite numbers", reason=_INVALID)
        if max(K[0, 2], K[1, 2]) <= 0.5 and (K[2, 0] > 1.0 or K[2, 1] > 1.0):
            raise DatasetError(f"{name}: the intrinsics are transposed: rows are [fx, 0, cx], ...", reason=_INVALID)
        if not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0.0, 0.0, 0.0, 1.0)) or min(K[0, 0], K[1, 1]) <= 0.0:
            said = f"focal lengths {K[0, 0]:g}, {K[1, 1]:g}; last row {K[2].tolist()}"
            raise DatasetError(f"{name}: the intrinsics are not a camera matrix: {said}", reason=_INVALID)
        if K[:2].max() < _LEAST_PIXELS:
            said = "are relative to the image size: multiply fx and cx by its width, fy and cy by its height"
            raise DatasetError(f"{name}: the intrinsics {said}", reason=_INVALID)
        if abs(K[0, 1]) > 1e-3 * K[0, 0]:
            raise DatasetError(f"{name}: the camera's axes are skewed", reason="DATASET_CAMERA_UNSUPPORTED")
        if self.size is not None:
            height, width = self.size
            shares = K[0, 0] / width, K[1, 1] / height
            if not all(_FOCAL[0] < share < _FOCAL[1] for share in shares):
                raise DatasetError(
                    f"{name}: focal lengths of {K[0, 0]:g}, {K[1, 1]:g} for {width} x {height}", reason=_INVALID
                )
            if self.off_middle(self.size) > _OFF_MIDDLE:
                raise DatasetError(
                    f"{name}: the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is not inside the image, {width} x"
                    f" {height}. Check whether the intrinsics are for another resolution.",
                    reason=_INVALID,
                )
            self._check_lens(name)
        return self

    def _check_lens(self, name: str) -> None:
        """A lens must be one-to-one over the image: a model that folds was fitted to something else."""
        if self.lens == "none":
            return
        assert self.size is not None
        height, width = self.size
        edge = np.array([(x * width, y * height) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)])
        aim = (edge - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]
        slopes = aim
        with np.errstate(all="ignore"):
            for _ in range(_ROUNDS):
                slopes = slopes + (aim - self._bent(slopes))
            off = np.abs(self._bent(slopes) - aim).max()
        if not off < 0.02:
            raise DatasetError(
                f"{name}: the distortion of the lens is too large for its model", reason="DATASET_CAMERA_UNSUPPORTED"
            )

    def _bent(self, slopes: Array) -> Array:
        """Slopes (P, 2) before the lens to those behind it. Formulas: OpenCV's documentation of calib3d and fisheye."""
        if self.lens == "none":
            return slopes
        x, y = slopes.T
        squared = x * x + y * y
        if self.lens == "fisheye":
            k1, k2, k3, k4 = self.distortion
            radius = np.sqrt(squared)
            angle = np.arctan(radius)
            a = angle * angle
            bent = angle * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
            return slopes * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)[:, None]
        if self.lens == "inverse":
            found, brown = slopes, replace(self, lens="brown")
            for _ in range(_ROUNDS):
                found = found + (slopes - brown._bent(found))
            return found
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *([0.0] * 8))[:8]
        r = squared
        radial = (1.0 + r * (k1 + r * (k2 + r * k3))) / (1.0 + r * (k4 + r * (k5 + r * k6)))
        sideways = np.stack(
            [2.0 * p1 * x * y + p2 * (r + 2.0 * x * x), p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y], axis=1
        )
        return np.asarray(slopes * radial[:, None] + sideways)


def camera_of(
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    size: Size | None = None,
    lens: tuple[Lens, tuple[float, ...]] = ("none", ()),
    whole_centers: bool = False,
) -> Camera:
    """Of numbers in pixels. whole_centers: a pixel's center lies at whole numbers for its writer, as for OpenCV."""
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(K + HALF_A_PIXEL if whole_centers else K, size, *lens)


# Files of intrinsics. Writers of sensors take pixel centers to lie at whole numbers.


@dataclass(frozen=True, eq=False)
class CameraFile:
    """What a file says of a camera. depth_unit: meters a step of its depth images, or None · pose: what stands under
    T_world_camera, or None."""

    camera: Camera
    depth_unit: float | None = None
    pose: Any = None


def read_camera_file(path: Path) -> CameraFile | None:
    """The camera of a file by Open3D, RealSense, Kinect, BOP, ROS (CameraInfo), or of a matrix or four numbers as text.

    None where the file holds no intrinsics. Raises DatasetError (DATASET_INTRINSICS_INVALID) for ones that are wrong.
    """
    if path.stat().st_size > _MOST_BYTES:
        return None
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy":
            return camera_of_values(np.load(path, allow_pickle=False).tolist(), path.name)
        text = decode_text(path.read_bytes())
        if suffix in (".json", ".yaml", ".yml"):
            return camera_of_values(json.loads(text) if suffix == ".json" else _first_of_yaml(text), path.name)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path.name} cannot be read: {error}", reason=_INVALID) from error
    if named := dict(_NAMED.findall(text)):
        return camera_of_values(named, path.name)
    numbers = [_numbers(line) for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    return _of_rows([row for row in numbers if row], path.name)


def _first_of_yaml(text: str) -> Any:
    """The first document. Raises ValueError."""
    import yaml

    try:
        return next(yaml.safe_load_all(_OPENCV.sub("", text)), None)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def camera_of_values(values: Any, name: str) -> CameraFile | None:
    """As :func:`read_camera_file`, of a JSON or YAML document; the first object in it that holds intrinsics."""
    for each in _objects({"K": values} if isinstance(values, list) else values):
        found = _matrix(each, name)
        if found is not None:
            width, height = _first(each, "width", "w", "image_width"), _first(each, "height", "h", "image_height")
            if isinstance(resolution := each.get("resolution"), list) and len(resolution) == 2:  # Kalibr
                width, height = resolution
            size = (int(height), int(width)) if width and height else None
            lens, coefficients = _lens(each, name)
            K = found + HALF_A_PIXEL
            camera = Camera(K, size, lens, coefficients).check(name)
            stated = _first(each, "depth_scale", "depth_units", "scale", "depth_unit", "DepthMapFactor")
            unit = _NAMED_UNITS.get(str(each.get("depth_unit"))) or depth_unit(stated)
            if unit is None and each.get("depth_unit") is not None:
                told = (
                    f"{name}: depth_unit {str(each['depth_unit'])[:40]!r}: expected meters per step such as 0.001,"
                    f" or mm"
                )
                raise DatasetError(told, reason=_INVALID)
            return CameraFile(camera, unit, each.get("T_world_camera"))
    return None


def depth_unit(stated: float | None) -> float | None:
    """Meters a step, of a number that is meters a step (RealSense), millimeters a step (BOP) or steps a meter (TUM)."""
    if stated is None or not stated > 0.0:
        return None
    low, high = _UNITS_M
    return next((unit for unit in (stated, stated * 0.001, 1.0 / stated) if low <= unit <= high), None)


def _objects(values: Any, depth: int = 0) -> Iterable[Mapping[str, Any]]:
    """The JSON objects of a document, the outer ones first, those of color cameras last."""
    if isinstance(values, Mapping):
        yield values
        if depth < 4:
            for key in sorted(values, key=of_color):
                yield from _objects(values[key], depth + 1)


def of_color(name: Any) -> bool:
    """Whether a name says that it is of a color camera."""
    return re.search("colou?r|rgb", str(name), re.IGNORECASE) is not None


def _first(values: Mapping[str, Any], *names: str) -> float | None:
    for name in names:
        value = values.get(name)
        if isinstance(value, str) and len(numbers := _numbers(value)) == 1:
            value = numbers[0]
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    return None


def _matrix(values: Mapping[str, Any], name: str) -> Array | None:
    """The camera matrix as written, centers at whole numbers; None where there is none."""
    fx, fy = _first(values, "fx", "fl_x"), _first(values, "fy", "fl_y")
    cx, cy = _first(values, "cx", "ppx"), _first(values, "cy", "ppy")
    if None not in (fx, cx, cy):
        return np.array([[fx, 0.0, cx], [0.0, fy or fx, cy], [0.0, 0.0, 1.0]], np.float64)
    for key in ("intrinsic_matrix", "camera_matrix", "K", "k", "cam_K", "intrinsics", "intrinsic", "P", "p"):
        value = values.get(key)
        if isinstance(value, Mapping):
            value = value.get("data")
        try:
            matrix = np.array(value, np.float64)
        except (TypeError, ValueError):
            continue
        if matrix.shape == (9,):  # Open3D writes columns first
            matrix = matrix.reshape(3, 3).T if key == "intrinsic_matrix" else matrix.reshape(3, 3)
        if matrix.shape == (12,):
            matrix = matrix.reshape(3, 4)
        if matrix.shape in ((3, 3), (4, 4), (3, 4)):
            return matrix[:3, :3]
        if matrix.shape == (4,):
            return np.array([[matrix[0], 0.0, matrix[2]], [0.0, matrix[1], matrix[3]], [0.0, 0.0, 1.0]])
        if value is not None and matrix.dtype.kind == "f" and matrix.size:
            raise DatasetError(f"{name}: {key} is not a camera matrix: {matrix.size} numbers", reason=_INVALID)
    return None


def _lens(values: Mapping[str, Any], name: str) -> tuple[Lens, tuple[float, ...]]:
    """The lens's model and coefficients; all zero is none."""
    model = str(values.get("distortion_model", values.get("camera_model", values.get("model", "")))).lower()
    names = ("distortion_coefficients", "distortion_coeffs", "coeffs", "D", "d")
    given = next((values[key] for key in names if key in values), None)
    if isinstance(given, Mapping):
        given = given.get("data")
    if given is None:
        given = [_first(values, key) or 0.0 for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        if "fisheye" in model:
            given = [given[0], given[1], given[4], given[5]]
    kind, numbers = lens_of(given, "fisheye" in model or "equi" in model or "kannala" in model, name)
    return "inverse" if kind == "brown" and "inverse" in model else kind, numbers


def lens_of(coefficients: Any, fisheye: bool, name: str) -> tuple[Lens, tuple[float, ...]]:
    """A lens by OpenCV's coefficients. Raises DatasetError (DATASET_CAMERA_UNSUPPORTED)."""
    try:
        numbers = tuple(float(value) for value in coefficients)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{name}: the distortion coefficients are not numbers", reason=_INVALID) from error
    if not any(numbers):
        return "none", ()
    if not all(map(math.isfinite, numbers)):
        raise DatasetError(f"{name}: the distortion coefficients are not finite", reason=_INVALID)
    if fisheye:
        return "fisheye", (*numbers, 0.0, 0.0, 0.0, 0.0)[:4]
    if any(numbers[8:]):
        raise DatasetError(
            f"{name}: {len(numbers)} distortion coefficients: at most eight are supported",
            reason="DATASET_CAMERA_UNSUPPORTED",
        )
    return "brown", numbers[:8]


_WORDS = re.compile(r"[\s,;\[\]()]+")
_OPENCV = re.compile(r"^%YAML.*$|!!opencv-matrix|^(Camera\d?|RGBD)\.", re.MULTILINE)
"""What OpenCV's files, and those of ORB-SLAM, have that YAML has not."""
_NAMED = re.compile(r"\b(f[xy]|c[xy]|pp[xy]|width|height)\s*[:=]\s*([-+.\deE]+)")
"""Numbers of a text that have names."""


def _numbers(line: str) -> list[float]:
    """A line's numbers; none where a word is not a number."""
    try:
        return [float(word) for word in _WORDS.split(line) if word]
    except ValueError:
        return []


def _of_rows(rows: list[list[float]], name: str) -> CameraFile | None:
    """A matrix in three or four rows, or one row of fx fy cx cy with or without coefficients after them."""
    if len(rows) in (3, 4) and all(len(row) == len(rows[0]) and len(row) in (3, 4) for row in rows):
        matrix = np.array(rows)[:3, :3]
    elif len(rows) == 1 and len(rows[0]) == 9:
        matrix = np.array(rows[0]).reshape(3, 3)
    elif len(rows) == 1 and len(rows[0]) == 6 and min(rows[0]) > _LEAST_PIXELS:  # no lens has such coefficients
        width, height, fx, fy, cx, cy = rows[0]
        camera = camera_of(fx, fy, cx, cy, (int(height), int(width)), whole_centers=True)
        return CameraFile(camera.check(name))
    elif len(rows) == 1 and 4 <= len(rows[0]) <= 12:
        fx, fy, cx, cy = rows[0][:4]
        lens = lens_of(rows[0][4:], False, name)
        return CameraFile(camera_of(fx, fy, cx, cy, None, lens, whole_centers=True).check(name))
    else:
        return None
    return CameraFile(Camera(matrix + HALF_A_PIXEL).check(name))
