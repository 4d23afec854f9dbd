"""Small sound runs in every packing, and settings of every trainer, for the fuzzer to begin with."""

from __future__ import annotations

import bz2
import gzip
import json
import lzma
import zipfile

from tests.core.importing.archives import zip_bytes
from tests.core.importing.settings import configurations
from tests.gate.bad_runs import tar_bytes


def make_runs(deepsdf: bytes, codes: bytes, scaling: bytes) -> dict[str, bytes]:
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


def make_settings() -> dict[str, bytes]:
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
