"""The image files of a dataset: colors, depths and masks, each checked against the size that is due."""

from __future__ import annotations

import struct
import tokenize
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from regnf_core.errors import DatasetError

Size = tuple[int, int]
"""Height and width, pixels."""

_FAULTS_OF_CONTENT = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
"""What pillow and numpy raise on malformed files."""


def resolve(folder: Path, name: Any, what: str) -> Path:
    """The file ``name`` in the folder, which it may not leave.

    Raises DatasetError (DATASET_METADATA_INVALID, DATASET_PATH_OUTSIDE, DATASET_IMAGE_MISSING).
    """
    if not isinstance(name, str) or not name or "\0" in name:
        raise DatasetError(f"{what} is not a path", reason="DATASET_METADATA_INVALID")
    try:
        path = (folder / name).resolve()
        inside = path.is_relative_to(folder.resolve())
        exists = inside and path.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # too long, links in a circle, half a character
        raise DatasetError(f"{what} cannot be followed: {name!r:.200}", reason="DATASET_METADATA_INVALID") from error
    if not inside:
        raise DatasetError(f"{what} leaves the dataset's folder: {name!r:.200}", reason="DATASET_PATH_OUTSIDE")
    if not exists:
        raise DatasetError(f"{what} names no file of the dataset: {name!r:.200}", reason="DATASET_IMAGE_MISSING")
    return path


def image_size(path: Path) -> Size:
    """Height and width by the file's header."""
    try:
        with Image.open(path) as image:
            return image.height, image.width
    except _FAULTS_OF_CONTENT as error:
        raise _invalid(path, error) from error


def read_colors(path: Path, size: Size) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, sRGB; transparency is left out."""
    return np.asarray(_decoded(path, size, "RGB"), dtype=np.uint8)


def read_mask(path: Path, size: Size) -> NDArray[np.bool_]:
    """(H, W): true where the picture is brighter than half; one of zeros and ones counts as such."""
    gray = _decoded(path, size, "L")
    return np.asarray(gray > (127 if gray.max() > 1 else 0))


def read_depth(path: Path, size: Size, unit: float | None) -> NDArray[np.float32]:
    """(H, W) float32 in world units, 0 where there is none: what is not finite and positive counts as none, and so does
    the largest number that a file's type has (65535 in many recordings).

    ``.npy`` holds world units; an image holds whole numbers of ``unit`` world units each.
    Raises DatasetError (DATASET_DEPTH_UNIT_MISSING, DATASET_SIZES_DIFFER, DATASET_IMAGE_INVALID).
    """
    stored = _array_file(path, size) if path.suffix.lower() == ".npy" else None
    if stored is None and unit is None:
        raise DatasetError(
            f"{path.name}: a depth image needs depth_unit_scale_factor in the metadata",
            reason="DATASET_DEPTH_UNIT_MISSING",
        )
    if stored is None:
        stored, factor = _decoded(path, size, None), unit or 1.0
    else:
        factor = 1.0
    largest = np.finfo(stored.dtype).max if stored.dtype.kind == "f" else np.iinfo(stored.dtype).max
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (stored.astype(np.float64) * factor).astype(np.float32)
        measured = np.isfinite(depth) & (depth > 0.0) & (stored < largest)
    return np.where(measured, depth, np.float32(0.0))


def _array_file(path: Path, size: Size) -> NDArray[Any]:
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        shape, kind = stored.shape, stored.dtype.kind
    except _FAULTS_OF_CONTENT as error:
        raise _invalid(path, error) from error
    if kind not in "fiu":
        raise DatasetError(f"{path.name} holds no numbers", reason="DATASET_IMAGE_INVALID")
    if shape not in (size, (*size, 1), (1, *size)):
        raise _differs(path, shape, size)
    return np.array(stored).reshape(size)


def _decoded(path: Path, size: Size, mode: str | None) -> NDArray[Any]:
    try:
        with Image.open(path) as image:
            # Told by the header: nothing of the wrong size is decoded.
            if (image.height, image.width) != size:
                raise _differs(path, (image.height, image.width), size)
            kind, pixels = image.mode, np.asarray(image.convert(mode) if mode else image)
    except _FAULTS_OF_CONTENT as error:
        raise _invalid(path, error) from error
    if pixels.shape[:2] != size or (mode is None and pixels.ndim != 2):
        raise DatasetError(f"{path.name} has more than one channel", reason="DATASET_IMAGE_INVALID")
    if mode is None and (kind == "P" or pixels.dtype.kind not in "fiu"):
        what = "a palette of colors" if kind == "P" else "one bit a pixel, as masks have"
        raise DatasetError(f"{path.name} holds no depths: it has {what}", reason="DATASET_IMAGE_INVALID")
    return pixels


def _differs(path: Path, found: tuple[int, ...], size: Size) -> DatasetError:
    shape = " x ".join(map(str, found))
    return DatasetError(
        f"{path.name} is {shape}, not {size[0]} x {size[1]} (height x width)", reason="DATASET_SIZES_DIFFER"
    )


def _invalid(path: Path, error: BaseException) -> DatasetError:
    return DatasetError(f"{path.name} cannot be read as an image: {error}", reason="DATASET_IMAGE_INVALID")
