"""Small sound files of every other kind that the gate takes."""

from __future__ import annotations

import base64
import bz2
import gzip
import io
import json
import lzma
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import torch
import trimesh

from tests.core.importing import onnx_models, test_nvblox, test_pin_slam, test_voxel_block_grid
from tests.core.importing import small_families as small
from tests.core.importing.archives import zip_bytes
from tests.core.importing.checkpoints import checkpoint
from tests.core.importing.meshes import mesh_files, test_point_clouds
from tests.core.importing.settings import configurations
from tests.gate.bad_runs import tar_bytes


def make_others() -> dict[str, dict[str, bytes]]:
    """The files by their stage and kind. Needs torch and the libraries that write such files."""
    return {
        "legacy": _legacy_files(),
        "arrays": _array_files(),
        "database": {"nvblox": _database(test_nvblox.ball_blocks()[::12])},
        "mesh": _mesh_files(),
        "onnx": _models(),
        "other": _checkpoints(),
        "run": _runs(),
        "settings": _settings(),
    }


def _legacy_files() -> dict[str, bytes]:
    files = {"neus_facto": _saved(checkpoint(log2_size=8, hidden=6, optimizer=False), legacy=True)}
    return files | {make.__name__: _saved(make().checkpoint, legacy=True) for make in (small.siren, small.deepsdf)}


def _array_files() -> dict[str, bytes]:
    axes = np.linspace(-1.0, 1.0, 9)
    distance = np.linalg.norm(np.stack(np.meshgrid(axes, axes, axes, indexing="ij")), axis=0) - 0.5
    grid = _arrays(sdf=distance.astype(np.float32), bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    return {"grid": grid, "voxels": _arrays(**test_voxel_block_grid.ball())}


def _mesh_files() -> dict[str, bytes]:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    around = test_point_clouds.directions(150)
    files = {kind: _bytes(ball.export(file_type=kind)) for kind in ("ply", "stl", "stl_ascii", "obj", "glb")}
    files["ply_ascii"] = _bytes(ball.export(file_type="ply", encoding="ascii"))
    document, parts = mesh_files.glb_parts()
    for name, data in parts.items():
        document = document.replace(name.encode(), b"data:;base64," + base64.b64encode(data))
    files |= {"gltf": document, "strips": mesh_files.strips_ply(), "strips_binary": mesh_files.strips_ply(binary=True)}
    for form in ("ascii", "binary", "binary_compressed"):
        files[f"pcd_{form}"] = mesh_files.pcd(0.5 * around, around, form)
    files["xyz"] = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in np.hstack([around, around])).encode()
    return files | {"cloud": test_point_clouds.ply(0.5 * around, around)}


def _models() -> dict[str, bytes]:
    layers = {"w": np.eye(3, 8, dtype=np.float32), "b": np.zeros(8, np.float32), "v": np.ones((8, 1), np.float32)}
    network = onnx_models.model("h = Gemm x w b; a = Relu h; y = MatMul a v", layers)
    older = onnx_models.model(
        "h = Gemm x w b; a = Clip h min:0.0; s = Softmax a axis:1; y = MatMul s v", layers, opset=9
    )
    models = {"sphere": onnx_models.sphere(), "network": network, "older": older}
    return {name: each.SerializeToString() for name, each in models.items()}


def _checkpoints() -> dict[str, bytes]:
    """Of other trainers, in the container of today."""
    files = {"pin_slam": _saved(test_pin_slam.floor())}
    for make in (small.neus, small.siren, small.deepsdf, small.instant_nsr_pl):
        files[make.__name__] = _saved(make().checkpoint)
    return files


def _runs() -> dict[str, bytes]:
    whole = small.deepsdf().checkpoint
    network = {name: value for name, value in whole.items() if name != "latent_codes"}
    scaling = _arrays(offset=np.zeros(3, np.float32), scale=np.array([0.5], np.float32))
    return _packed_runs(
        _saved(network), _saved({"epoch": 1, "latent_codes": whole["latent_codes"]}, legacy=True), scaling
    )


def _packed_runs(deepsdf: bytes, codes: bytes, scaling: bytes) -> dict[str, bytes]:
    """Archives of a DeepSDF's run: its network, its latent codes, and how its shape was scaled."""
    specs = {"NetworkSpecs": {"latent_in": [2]}, "CodeLength": 5}
    members = [
        ("run/specs.json", json.dumps(specs).encode()),
        ("run/ModelParameters/1.pth", deepsdf),
        ("run/LatentCodes/1.pth", codes),
        ("run/data/NormalizationParameters/a.npz", scaling),
    ]
    tar = tar_bytes(members)
    packed = {"gzip": gzip.compress(tar, 1, mtime=0), "bzip2": bz2.compress(tar, 1), "xz": lzma.compress(tar, preset=0)}
    return {"zip": zip_bytes(members, zipfile.ZIP_DEFLATED), "stored": zip_bytes(members), "tar": tar, **packed}


def _settings() -> dict[str, bytes]:
    """Files of settings, each behind a line with its name."""
    files = {
        "sdfstudio": ("config.yml", configurations.studio(False)),
        "nerfstudio": ("config.yml", configurations.studio(True)),
        "nsr": ("parsed.yaml", configurations.nsr("ProgressiveBandHashGrid", configurations.BAND)),
        "angelo": ("config.yaml", configurations.ANGELO % ("True", 4)),
        "neus": ("a.conf", configurations.NEUS_CONF.format(scale=3.0, layers=8, skip=4)),
        "volsdf": (
            "a.conf",
            "model { scene_bounding_sphere = 3.0\n implicit_network\n { dims = [ 8, 8 ]\n multires = 6 } }",
        ),
        "deepsdf": ("specs.json", json.dumps(configurations.SPECS)),
        "pin_slam": ("run.yaml", "neuralpoints: {voxel_size_m: 0.3}\nloss: {sigma_sigmoid_m: 0.1}\n"),
        "sines": ("config.yaml", "model: {omega_0: 30.0}\n"),
        "fusion": ("config.yaml", "integrate: {voxel_size: 0.01, trunc_voxel_multiplier: 8}\n"),
    }
    return {kind: f"{name}\n{text}".encode() for kind, (name, text) in files.items()}


def _bytes(data: bytes | str) -> bytes:
    return data.encode() if isinstance(data, str) else bytes(data)


def _arrays(**arrays: object) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _database(rows: list[tuple[int, int, int, bytes]]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return test_nvblox.write_map(Path(folder, "map"), rows).read_bytes()


def _saved(values: object, legacy: bool = False) -> bytes:
    buffer = io.BytesIO()
    torch.save(values, buffer, _use_new_zipfile_serialization=not legacy)
    return buffer.getvalue()
