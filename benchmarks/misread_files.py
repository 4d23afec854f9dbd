"""Plausible but wrong files: sound files of a chiral solid, each with one error that a person or a program makes.

A case is a file, what its maker meant, and what has to be said of it if it is taken: ``said`` matches the line of the
report that is about the error. Errors that keep a file sound (another unit, a mirrored axis) are written by the twins'
own writers; the others change numbers, bytes or headers.
"""

from __future__ import annotations

import io
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from tests.core.importing import onnx_models, twins
from tests.core.importing.twins import Array, Twin

Random = np.random.Generator
STEP = 0.1
UNITS = (10.0, 25.4, 100.0, 1000.0)
MEANT_UNIT, AXES = r"unit:", r"axes: .*right-handed"
SIGN = r"sign:|SIGN_UNCERTAIN|MOSTLY_INSIDE|MESH_INSIDE_OUT|SCENE_ASSUMED|NORMALS_"
SLOPE = "GRADIENT_NOT_UNIT"
ORDER = r"order: the axes of the array|AXES_UNCERTAIN"
LOST = r"ignored: .*(bytes|triangles|vertices|points)"
GARBLED = rf"{SLOPE}|AXES_UNCERTAIN|STRAY_PARTS|GEOMETRY_IGNORED: .*contradict"
_ROTATIONS = [
    np.eye(3)[list(order)] * signs
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(np.eye(3)[list(order)] * signs) > 0
]


@dataclass(frozen=True, eq=False)
class Case:
    """data: the file · meant: the solid as its maker has it, in the file's unit, or None where it is no solid · said:
    what a line about the error matches."""

    reader: str
    error: str
    data: bytes
    said: str
    meant: Twin | None
    options: dict[str, Any] = field(default_factory=dict)


@cache
def twin_of(number: int) -> Twin:
    """One of the solids, some unit, place and orientation; the same for a number."""
    random = np.random.default_rng(number)
    scale = float(np.exp(random.uniform(math.log(0.2), math.log(500.0))))
    shift = tuple(float(value) for value in random.uniform(-1.0, 1.0, 3) * scale)
    return Twin(_ROTATIONS[random.integers(len(_ROTATIONS))], scale, (shift[0], shift[1], shift[2]))


# Errors after which the file is as sound as before: the writer's frame or unit is another one.


def other_frame(twin: Twin, random: Random) -> tuple[str, Twin, str]:
    """The error, the solid as the file has it, and what is said of it."""
    kind = random.choice(["unit", "axis mirrored", "axes permuted", "another axis up"])
    if kind == "unit":
        factor = float(random.choice(UNITS) ** random.choice([-1, 1]))
        shift = tuple(factor * value for value in twin.shift)
        return kind, replace(twin, scale=factor * twin.scale, shift=shift), MEANT_UNIT  # type: ignore[arg-type]
    if kind == "axis mirrored":
        turn = np.diag(np.where(np.arange(3) == random.integers(3), -1.0, 1.0))
    elif kind == "axes permuted":
        turn = np.eye(3)[list(list(permutations(range(3)))[random.integers(1, 6)])]
    else:
        turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        turn = turn if random.random() < 0.5 else turn.T
    x, y, z = (turn @ np.array(twin.shift)).tolist()
    return kind, replace(twin, M=turn @ twin.M, shift=(x, y, z)), rf"{AXES}|order: columns"


SOUND: dict[str, Callable[[Twin], bytes]] = twins.WRITERS | {
    "grid": lambda twin: npz(twins.grid_arrays(twin, STEP)),
    "voxel blocks": lambda twin: npz(blocks_of(twin)),
    "nvblox": lambda twin: twins.nvblox(twin, STEP),
}


@cache
def blocks_of(twin: Twin) -> dict[str, Any]:
    return twins.voxel_block_arrays(twin, STEP)


def framed(reader: str, twin: Twin, random: Random) -> Case:
    error, written, said = other_frame(twin, random)
    return Case(reader, error, SOUND[reader](written), said, twin)


# Arrays: a header may claim another type, order or shape than the bytes have.


def npz(arrays: dict[str, Any], forged: dict[str, tuple[bytes, dict[str, Any]]] | None = None) -> bytes:
    """forged: by name, the bytes of an array and the header that is put before them."""
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, array in arrays.items():
            one, plain = io.BytesIO(), np.asarray(array)
            raw, header = (forged or {}).get(name, (plain.tobytes(), {}))
            npy.write_array_header_1_0(
                one, {"descr": plain.dtype.str, "fortran_order": False, "shape": plain.shape, **header}
            )
            file.writestr(f"{name}.npy", one.getvalue() + raw)
    return out.getvalue()


def wrong_grid(reader: str, twin: Twin, random: Random) -> Case:
    arrays = twins.grid_arrays(twin, STEP)
    values, low, spacing = arrays["sdf"], arrays["origin"], arrays["spacing"]
    high, step = low + spacing * (np.array(values.shape) - 1), float(spacing[0])
    bounds, middle = {"sdf": values, "bounds": np.stack([low, high])}, (low + high) / 2
    placed = rf"BOUNDS|{SLOPE}|AXES_|order: .*bounds"
    order = list(permutations(range(3)))[random.integers(1, 6)]
    factor = float(random.choice(UNITS) ** random.choice([-1, 1]))
    thin = {**arrays, "sdf": values[:, :, ::2], "spacing": spacing * (1, 1, 2)}
    made: dict[str, tuple[dict[str, Any], str]] = {
        "axes of the array permuted": (arrays | {"sdf": values.transpose(order)}, ORDER),
        "the same, spacing per axis": (thin | {"sdf": thin["sdf"].transpose(order)}, ORDER),
        "the same, placed by bounds": (bounds | {"sdf": values.transpose(order)}, ORDER),
        "an axis of the array mirrored": (arrays | {"sdf": np.flip(values, random.integers(3))}, rf"{AXES}|{ORDER}"),
        "sign flipped": (arrays | {"sdf": -values}, SIGN),
        "values in another unit": (arrays | {"sdf": values * np.float32(factor)}, SLOPE),
        "values over the truncation": (arrays | {"sdf": np.clip(values / np.float32(4 * step), -1, 1)}, SLOPE),
        "values in steps": (arrays | {"sdf": values / np.float32(step)}, SLOPE),
        "values squared": (arrays | {"sdf": values * np.abs(values)}, SLOPE),
        "unsigned": (arrays | {"sdf": np.abs(values)}, SIGN),
        "occupancy": (arrays | {"sdf": (values > 0).astype(np.float32) - np.float32(0.5)}, SLOPE),
        "places of cell corners": (arrays | {"origin": low - spacing / 2}, r"order: .*nodes"),
        "origin in the middle": (arrays | {"origin": middle}, r"order: .*nodes"),
        "cells per unit": (arrays | {"spacing": 1.0 / spacing}, SLOPE),
        "spacing in another unit": (arrays | {"spacing": spacing * factor}, SLOPE),
        "bounds as corner and size": (bounds | {"bounds": np.stack([low, high - low])}, placed),
        "bounds as center and size": (bounds | {"bounds": np.stack([middle, high - low])}, placed),
        "bounds as center and half": (bounds | {"bounds": np.stack([middle, (high - low) / 2])}, placed),
        "decimated": (arrays | {"sdf": values[::2, ::2, ::2]}, SLOPE),
    }  # fmt: skip
    headers: dict[str, tuple[bytes, dict[str, Any], str]] = {
        "Fortran's order not said": (values.tobytes("F"), {}, GARBLED),
        "C's order said to be Fortran's": (values.tobytes(), {"fortran_order": True}, GARBLED),
        "shape turned round": (values.tobytes(), {"shape": values.shape[::-1]}, GARBLED),
        "big-endian bytes": (values.astype(">f4").tobytes(), {}, GARBLED),
        "float64 said to be float32": (
            values.astype(np.float64).tobytes(),
            {"shape": (*values.shape[:2], 2 * values.shape[2])},
            GARBLED,
        ),
        "int16 said to be float16": (
            np.round(values / step * 100).astype("<i2").tobytes(), {"descr": "<f2"}, GARBLED,
        ),
    }  # fmt: skip
    error = str(random.choice([*made, *headers]))
    if error in made:
        changed, said = made[error]
        return Case(reader, error, npz(changed), said, twin)
    raw, header, said = headers[error]
    return Case(reader, error, npz(arrays, {"sdf": (raw, header)}), said, twin)


def wrong_blocks(reader: str, twin: Twin, random: Random) -> Case:
    arrays = blocks_of(twin)
    name = f"value_{int(arrays['attr_name_tsdf'].ravel()[0]):03d}"
    tsdf, size = arrays[name], float(arrays["voxel_size"].ravel()[0])
    turned = np.ascontiguousarray(tsdf.transpose(0, 3, 2, 1, 4))
    keys = arrays["key"]
    factor = float(random.choice(UNITS) ** random.choice([-1, 1]))
    both = {"attr_name_tsdf": arrays["attr_name_weight"], "attr_name_weight": arrays["attr_name_tsdf"]}
    made = {
        "voxels with x first": ({name: turned}, GARBLED),
        "keys z, y, x": ({"key": np.ascontiguousarray(keys[:, ::-1])}, GARBLED),
        "voxels and keys z, y, x": ({name: turned, "key": np.ascontiguousarray(keys[:, ::-1])}, AXES),
        "sign flipped": ({name: -tsdf}, SIGN),
        "distances not divided": ({name: tsdf * np.float32(4 * size)}, SLOPE + "|TRUNCATION_ASSUMED"),
        "voxel size in another unit": ({"voxel_size": arrays["voxel_size"] * np.float32(factor)}, MEANT_UNIT),
        "weights for distances": (both, SIGN + "|" + SLOPE),
        "big-endian keys": ({"key": keys.byteswap()}, GARBLED),
        "big-endian values": ({name: tsdf.byteswap()}, GARBLED),
        "keys of voxels": ({"key": keys * 8}, GARBLED),
        "an axis mirrored in keys alone": ({"key": keys * np.array([-1, 1, 1], keys.dtype)}, GARBLED),
    }  # fmt: skip
    error = str(random.choice(list(made)))
    changed, said = made[error]
    return Case(reader, error, npz(arrays | changed), said, twin)


def wrong_nvblox(reader: str, twin: Twin, random: Random) -> Case:
    def transposed(block: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(block.transpose(2, 1, 0, 3))

    size = STEP * twin.scale
    factor = float(random.choice(UNITS) ** random.choice([-1, 1]))
    made: dict[str, tuple[dict[str, Any], str]] = {
        "voxels with x fastest": ({"block": transposed}, GARBLED),
        "indices z, y, x": ({"index": lambda index: index[::-1]}, GARBLED),
        "both z, y, x": ({"block": transposed, "index": lambda index: index[::-1]}, AXES),
        "weight before distance": ({"block": lambda block: block[..., ::-1]}, SIGN + "|" + SLOPE),
        "sign flipped": ({"block": lambda block: block * np.array([-1, 1], "<f4")}, SIGN),
        "big-endian": ({"block": lambda block: block.astype("<f4").byteswap()}, GARBLED),
        "distances in voxels": ({"block": lambda block: block / np.array([size, 1], "<f4")}, SLOPE),
        "distances in another unit": ({"block": lambda block: block * np.array([factor, 1], "<f4")}, SLOPE),
        "the voxel's size as the block's": ({"edge": size}, SLOPE),
    }
    error = str(random.choice(list(made)))
    changed, said = made[error]
    return Case(reader, error, twins.nvblox(twin, STEP, **changed), said, twin)


# Meshes and clouds, by writers of a few lines, so that a header may claim something else.


def wrong_mesh(reader: str, twin: Twin, random: Random) -> Case:
    mesh = twin.mesh
    places, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    some = random.random(len(faces)) < random.uniform(0.1, 0.9)
    kind = str(random.choice(["flipped", "some flipped", *_TEXT_ERRORS[reader]]))
    if kind == "flipped":
        faces = faces[:, ::-1]
    elif kind == "some flipped":
        faces = np.where(some[:, None], faces[:, ::-1], faces)
    about = r"MESH_INSIDE_OUT|SCENE_ASSUMED|of its surface was flipped" if "flipped" in kind else GARBLED
    about = AXES if "swapped" in kind else rf"{LOST}|not watertight" if kind == "one face fewer" else about
    data = MESHES[reader](places, faces, kind)
    return Case(reader, kind if "flipped" not in kind else f"faces {kind}", data, about, twin)


_TEXT_ERRORS = {
    "ply": ("one vertex fewer", "one face fewer", "big-endian", "faces from 1", "double", "x and z swapped"),
    "ply text": ("one vertex fewer", "one face fewer", "decimal comma", "faces from 1", "x and z swapped"),
    "obj": ("decimal comma", "faces from 0", "faces from 2", "x and z swapped"),
    "stl": ("one face fewer", "one face more", "big-endian"),
    "glb": ("one vertex fewer", "one face fewer", "big-endian", "shifted by a number"),
}
"""Beside faces that are turned."""


def _ply(places: Array, faces: NDArray[np.int64], kind: str, text: bool = False) -> bytes:
    number = "double" if kind == "double" else "float"
    form = "ascii" if text else "binary_big_endian" if kind == "big-endian" else "binary_little_endian"
    counts = len(places) - (kind == "one vertex fewer"), len(faces) - (kind == "one face fewer")
    head = f"ply\nformat {form} 1.0\nelement vertex {counts[0]}\n"
    head += "".join(f"property {number} {name}\n" for name in "xyz")
    head += f"element face {counts[1]}\nproperty list uchar int vertex_indices\nend_header\n"
    faces = faces + (kind == "faces from 1")
    places = places[:, ::-1] if kind == "x and z swapped" else places
    if not text:
        rows = np.zeros(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
        rows["n"], rows["corners"] = 3, faces
        return head.encode() + places.astype("<f4").tobytes() + rows.tobytes()
    lines = [*(" ".join(f"{v:.6f}" for v in row) for row in places), *(f"3 {a} {b} {c}" for a, b, c in faces)]
    body = "\n".join(lines) + "\n"
    return (head + (body.replace(".", ",") if kind == "decimal comma" else body)).encode()


def _obj(places: Array, faces: NDArray[np.int64], kind: str) -> bytes:
    start = {"faces from 0": 0, "faces from 2": 2}.get(kind, 1)
    places = places[:, ::-1] if kind == "x and z swapped" else places
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in places] + [f"f {a} {b} {c}" for a, b, c in faces + start]
    text = "\n".join(lines) + "\n"
    return (text.replace(".", ",") if kind == "decimal comma" else text).encode()


def _stl(places: Array, faces: NDArray[np.int64], kind: str) -> bytes:
    rows = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows["corners"] = places[faces]
    count = len(faces) - (kind == "one face fewer") + (kind == "one face more")
    if kind == "big-endian":
        rows["corners"] = rows["corners"].byteswap()
    return bytes(80) + struct.pack("<I", count) + rows.tobytes()


def _glb(places: Array, faces: NDArray[np.int64], kind: str) -> bytes:
    corners, points = faces.astype("<u4"), places.astype("<f4")
    if kind == "big-endian":
        points = points.byteswap()
    at = 4 if kind == "shifted by a number" else 0
    binary = points.tobytes() + corners.tobytes()
    views = [{"buffer": 0, "byteOffset": at, "byteLength": points.nbytes},
             {"buffer": 0, "byteOffset": points.nbytes, "byteLength": corners.nbytes}]  # fmt: skip
    extent = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    fewer, count = 3 * (kind == "one face fewer"), len(points) - (kind == "one vertex fewer")
    accessors = [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count, **extent},
        {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": corners.size - fewer},
    ]  # fmt: skip
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    document = json.dumps({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }).encode()  # fmt: skip
    document += b" " * (-len(document) % 4)
    parts = struct.pack("<I4s", len(document), b"JSON") + document + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


MESHES: dict[str, Callable[[Array, NDArray[np.int64], str], bytes]] = {
    "ply": _ply,
    "ply text": lambda places, faces, kind: _ply(places, faces, kind, text=True),
    "obj": _obj,
    "stl": _stl,
    "glb": _glb,
}


def wrong_cloud(reader: str, twin: Twin, random: Random) -> Case:
    points, along = twin.cloud(1000)
    rows = np.hstack([points, along])
    numbered = np.arange(len(points))[:, None]
    order = list(permutations(range(3)))[random.integers(1, 6)]
    turn = np.concatenate([np.linspace(0.0, 1.0, 200)[:, None], points[:200], np.tile([0, 0, 0, 1], (200, 1))], axis=1)
    poses = np.concatenate([np.tile(np.eye(3), (200, 1, 1)), points[:200, :, None]], axis=2).reshape(200, 12)
    named = r"order: columns"
    made: dict[str, tuple[Array, str]] = {
        "normals flipped": (np.hstack([points, -along]), SIGN),
        "normals shuffled": (np.hstack([points, random.permutation(along)]), SIGN),
        "half of the normals flipped": (np.hstack([points, along * random.choice([-1, 1], (len(along), 1))]), SIGN),
        "numbered": (np.hstack([numbered, rows]), named),
        "columns swapped": (np.hstack([points[:, order], along[:, order]]), named),
        "normals first": (np.hstack([along, points]), named),
        "a column of intensities first": (np.hstack([random.random((len(rows), 1)), rows]), named),
        "poses of TUM": (turn, "pose"),
        "poses of KITTI": (poses, "pose"),
        "points alone": (points, SIGN),
        "decimal comma": (rows, "comma"),
        "count off by one": (rows, LOST + "|count"),
    }
    error = str(random.choice(list(made)))
    table, said = made[error]
    text = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in table) + "\n"
    if error == "decimal comma":
        text = text.replace(".", ",")
    if error == "count off by one":
        text = f"{len(table) - 1}\n{text}"
    return Case(reader, error, text.encode(), said, None if error.startswith("poses") else twin)


# A network: the distance to a ball beside the origin, as a graph.


def wrong_network(reader: str, _: Twin, random: Random) -> Case:
    center, scale = np.array([0.4, 0.1, -0.2], np.float32), np.float32(random.uniform(0.5, 0.9))
    radius = np.float32(0.3 * scale)
    factor = np.float32(random.choice(UNITS) ** random.choice([-1, 1]))
    order = np.array(list(permutations(range(3)))[random.integers(1, 6)])
    made: dict[str, tuple[dict[str, Any], str]] = {
        "inputs permuted": ({"c": center[order]}, r"order: the columns"),
        "an input mirrored": ({"c": center * np.float32([-1, 1, 1])}, rf"{AXES}"),
        "sign flipped": ({"s": np.float32([-1])}, SIGN),
        "distances in another unit": ({"s": np.float32([factor])}, SLOPE),
        "inputs in another unit": ({"c": center * factor, "r": np.float32([radius * factor])}, r"unit:|BOUNDS_ASSUMED"),
    }
    error = str(random.choice(list(made)))
    changed, said = made[error]
    weights = {"c": center, "r": np.float32([radius]), "s": np.float32([1.0])} | changed
    graph = "d = Sub x c; q = Mul d d; u = ReduceSum q one; e = Sqrt u; f = Sub e r; y = Mul f s"
    model = onnx_models.model(graph, weights | {"one": np.array([1], np.int64)})
    return Case(reader, error, model.SerializeToString(), said, None, {"ball": (center.tolist(), float(radius))})


MAKERS: dict[str, Callable[[str, Twin, Random], Case]] = {
    "grid": wrong_grid,
    "voxel blocks": wrong_blocks,
    "nvblox": wrong_nvblox,
    **dict.fromkeys(MESHES, wrong_mesh),
    "xyz cloud": wrong_cloud,
    "onnx": wrong_network,
}
