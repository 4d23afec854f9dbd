"""Gaussian splats in tables: PLY files of trainers and packed ones, SOG's images, glTF's attributes, checkpoints."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.meshes.accessors import Accessors
from regnf_core.importing.meshes.glb import gltf_parts, placed_meshes
from regnf_core.importing.meshes.ply import PlyTables
from regnf_core.importing.meshes.triangle_files import Siblings, elsewhere, malformed, unsupported
from regnf_core.importing.splats.gaussians import (
    SH_DC,
    Doubles,
    Floats,
    Splats,
    sigmoid,
    smallest_three,
    with_third_scale,
)
from regnf_core.importing.splats.packed import require_count

# PLY: as the trainers write it, or packed to 16 bytes a splat, with the extents of each 256 in a chunk.

_CHUNK = 256
_REST = re.compile(r"f_rest_[0-9]+")


def read_ply_splats(data: memoryview) -> Splats:
    """Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED."""
    tables = PlyTables(data)
    require_count(tables.count("vertex"))
    rows = tables.rows()
    vertex = rows["vertex"]
    if "packed_position" in (vertex.dtype.names or ()):
        return _unpacked(vertex, rows)
    return trained(vertex)


def trained(vertex: npt.NDArray[Any]) -> Splats:
    """The splats in rows with the trainers' names. Opacities are logits, scales logarithms."""
    names = vertex.dtype.names or ()
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    missing = [name for name in (*needed, *(f"rot_{part}" for part in range(4))) if name not in names]
    if missing:
        raise malformed(f"the Gaussians of the PLY file have no {missing[0]}")
    rest = sum(_REST.fullmatch(name) is not None for name in names)
    harmonics = [_columns(vertex, [f"f_dc_{channel}" for channel in range(3)])[:, None]]
    if rest in (9, 24, 45):
        table = _columns(vertex, [f"f_rest_{number}" for number in range(rest)])
        harmonics.append(table.reshape(-1, 3, rest // 3).transpose(0, 2, 1))
    elif rest:
        raise unsupported(f"Gaussians with {rest} coefficients of harmonics; 0, 9, 24 and 45 are read")
    scales, flat = with_third_scale(
        _columns(vertex, [name for name in ("scale_0", "scale_1", "scale_2") if name in names])
    )
    return Splats(
        np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1),
        scales,
        _columns(vertex, [f"rot_{part}" for part in range(4)]),
        sigmoid(vertex["opacity"]),
        np.concatenate(harmonics, axis=1),
        flat,
    )


def _columns(rows: npt.NDArray[Any], names: list[str]) -> Floats:
    found = np.empty((len(rows), len(names)), np.float32)
    for column, name in enumerate(names):
        found[:, column] = rows[name]
    return found


def _unpacked(vertex: npt.NDArray[Any], rows: Mapping[str, npt.NDArray[Any]]) -> Splats:
    chunks = rows.get("chunk")
    if chunks is None or len(chunks) * _CHUNK < len(vertex):
        raise malformed("the packed Gaussians of the PLY file have too few chunks")
    owner = np.arange(len(vertex)) // _CHUNK

    def between(shares: Doubles, name: str) -> Doubles:
        low, high = (_columns(chunks, [f"{end}_{name}{axis}" for axis in "xyz"])[owner] for end in ("min", "max"))
        return np.asarray(low + shares * (high - low), np.float64)

    try:
        means = between(_elevens(vertex["packed_position"]), "")
        scales = between(_elevens(vertex["packed_scale"]), "scale_")
        words = vertex["packed_rotation"].astype(np.int64)
        others = np.stack([words >> shift & 0x3FF for shift in (20, 10, 0)], axis=1) / 1023.0
        levels = np.stack([vertex["packed_color"] >> shift & 0xFF for shift in (24, 16, 8, 0)], axis=1) / 255.0
        colors: npt.NDArray[Any] = levels[:, :3]
        if "min_r" in (chunks.dtype.names or ()):
            low, high = (_columns(chunks, [f"{end}_{channel}" for channel in "rgb"])[owner] for end in ("min", "max"))
            colors = low + colors * (high - low)
    except (KeyError, ValueError) as error:
        raise malformed("the packed Gaussians of the PLY file lack a property") from error
    harmonics: list[npt.NDArray[Any]] = [((colors - 0.5) / SH_DC)[:, None]]
    if "sh" in rows and len(rows["sh"]) == len(vertex):
        table = _columns(rows["sh"], list(rows["sh"].dtype.names or ()))
        if table.shape[1] not in (9, 24, 45):
            raise malformed("the packed harmonics of the PLY file have another number of columns")
        coefficients = np.where(table == 0.0, 0.0, np.where(table == 255.0, 1.0, (table + 0.5) / 256.0))
        harmonics.append(((coefficients - 0.5) * 8.0).reshape(len(vertex), 3, -1).transpose(0, 2, 1))
    return Splats(
        means,
        scales.astype(np.float32),
        smallest_three(words >> 30, (others - 0.5) * np.sqrt(2.0)),
        levels[:, 3].astype(np.float32),
        np.concatenate(harmonics, axis=1).astype(np.float32),
    )


def _elevens(words: npt.NDArray[Any]) -> Doubles:
    """(N, 3) in [0, 1], of 11, 10 and 11 bits."""
    parts = [(words >> 21 & 0x7FF) / 2047.0, (words >> 11 & 0x3FF) / 1023.0, (words & 0x7FF) / 2047.0]
    return np.stack(parts, axis=1)


# SOG: one pixel a splat in several images, and how their levels are meant in meta.json.

_MOST_PIXELS = 64 << 20


def read_sog(data: memoryview, siblings: Siblings) -> Splats:
    """``data``: meta.json · siblings: the images by their names.

    Raises FieldFormatError: MESH_INVALID, MESH_EXTERNAL_REFERENCE, FORMAT_NOT_SUPPORTED.
    """
    try:
        said = json.loads(bytes(data))
        count = said.get("count", said["means"].get("shape", [0])[0])
        if not isinstance(count, int):
            raise malformed("meta.json has no count of Gaussians")
        require_count(count)
        pictures = {
            part: [_levels(name, siblings, count) for name in said[part]["files"]]
            for part in ("means", "scales", "quats", "sh0")
        }
        low, high = (np.array(said["means"][end], np.float64) for end in ("mins", "maxs"))
        fine, coarse = (picture[:count, :3].astype(np.int64) for picture in pictures["means"])
        places = low + (coarse << 8 | fine) / 65535.0 * (high - low)
        quats = pictures["quats"][0][:count]
        largest = quats[:, 3].astype(np.int64) - 252
        if largest.min() < 0:
            raise malformed("the quaternions of the SOG file have an invalid mode")
        color = _meant(pictures["sh0"][0][:count], said["sh0"])
        opacity = pictures["sh0"][0][:count, 3] / 255.0 if "codebook" in said["sh0"] else sigmoid(color[:, 3])
        harmonics = [color[:, None, :3]]
        if "shN" in said:
            harmonics.append(_from_palette(said["shN"], siblings, count))
        return Splats(
            np.sign(places) * np.expm1(np.abs(places)),
            _meant(pictures["scales"][0][:count, :3], said["scales"]),
            smallest_three(largest, (quats[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)),
            np.asarray(opacity, np.float32),
            np.concatenate(harmonics, axis=1).astype(np.float32),
        )
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise malformed("meta.json of the SOG file has an invalid entry") from error


def _meant(levels: npt.NDArray[np.uint8], said: Mapping[str, Any]) -> Floats:
    """The numbers that bytes stand for: entries of a codebook, or shares of an extent of each channel."""
    if "codebook" in said:
        book = np.array(said["codebook"], np.float32)
        if book.shape != (256,):
            raise malformed("a codebook of the SOG file has not 256 entries")
        return book[levels]
    low, high = (np.array(said[end], np.float32) for end in ("mins", "maxs"))
    return (low + levels[:, : len(low)] / np.float32(255.0) * (high - low)).astype(np.float32)


def _levels(name: object, siblings: Siblings, count: int) -> npt.NDArray[np.uint8]:
    """(pixels, 4) of an image that came with the file."""
    from PIL import Image, UnidentifiedImageError

    if not isinstance(name, str) or name not in siblings:
        raise elsewhere("meta.json of a SOG file names images that are not here: give the folder, or the .sog file")
    try:
        with Image.open(io.BytesIO(siblings[name]), formats=("WEBP", "PNG")) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise malformed("an image of the SOG file is too large")
            pixels = np.asarray(image.convert("RGBA")).reshape(-1, 4)
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise malformed("an image of the SOG file is damaged") from error
    if len(pixels) < count:
        raise malformed("an image of the SOG file has fewer pixels than there are Gaussians")
    return pixels


def _from_palette(said: Mapping[str, Any], siblings: Siblings, count: int) -> Floats:
    """(N, K, 3): each splat names an entry of a palette, whose images have 64 entries of K pixels a row."""
    files = {("labels" if "labels" in name else "centroids"): name for name in said["files"]}
    labels = _levels(files["labels"], siblings, count)[:count].astype(np.int64)
    centroids = _levels(files["centroids"], siblings, 1)
    entry = labels[:, 0] | labels[:, 1] << 8
    terms = {1: 3, 2: 8, 3: 15}[said["bands"]] if "bands" in said else _terms_of_shape(said)
    palette = centroids[: len(centroids) // terms * terms, :3].reshape(-1, terms, 3)
    values = _meant(palette.reshape(-1, 3), said) if "codebook" in said else _of_one_extent(palette, said)
    chosen: Floats = values.reshape(-1, terms, 3)[entry]
    return chosen


def _terms_of_shape(said: Mapping[str, Any]) -> int:
    return int(said["shape"][1]) // 3


def _of_one_extent(levels: npt.NDArray[np.uint8], said: Mapping[str, Any]) -> Floats:
    low, high = float(said["mins"]), float(said["maxs"])
    return (low + levels / np.float32(255.0) * (high - low)).astype(np.float32)


# glTF: points with the attributes of KHR_gaussian_splatting, at their nodes' poses.

EXTENSION = "KHR_gaussian_splatting"


def read_gltf_splats(data: memoryview, siblings: Siblings, node: str | None = None) -> Splats | None:
    """The splats of a glTF file, None where it has none. Raises FieldFormatError: as the reader of its meshes."""
    document, binary = gltf_parts(data)
    if EXTENSION not in json.dumps(document.get("extensionsUsed", [])):
        return None
    accessors, parts = Accessors(document, binary, siblings), []
    try:
        for placed in placed_meshes(document, accessors, node)[0]:
            for primitive in document["meshes"][placed.mesh]["primitives"]:
                said = primitive.get("extensions", {}).get(EXTENSION)
                if said is None:
                    continue
                if said.get("extensions"):
                    raise unsupported("the Gaussians of the glTF file are compressed: export them without compression")
                own = _of_attributes(primitive["attributes"], accessors)
                parts += [own.moved(matrix) for matrix in placed.matrices]
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise malformed("the glTF document contradicts itself") from error
    if not parts:
        return None
    return Splats.together(parts)


def _of_attributes(attributes: Mapping[str, Any], accessors: Accessors) -> Splats:
    def column(name: str, width: int) -> Doubles:
        return accessors.array(attributes[name], width)

    prefix = f"{EXTENSION}:"
    means = column("POSITION", 3)
    require_count(len(means))
    degree = 0
    while f"{prefix}SH_DEGREE_{degree + 1}_COEF_0" in attributes and degree < 3:
        degree += 1
    names = [f"{prefix}SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    with np.errstate(all="ignore"):
        scales = np.log(column(f"{prefix}SCALE", 3)).astype(np.float32)
    return Splats(
        means,
        scales,
        np.roll(column(f"{prefix}ROTATION", 4), 1, axis=1).astype(np.float32),
        column(f"{prefix}OPACITY", 1)[:, 0].astype(np.float32),
        np.stack([column(name, 3) for name in names], axis=1).astype(np.float32),
    )
