"""Checkpoints that hold no distance, or one that cannot be computed, are named, and the message says what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import ImportLimits

ONE = torch.ones(4)
CASES: dict[str, tuple[dict[str, Any], str]] = {
    "nerfacto of no known release": ({"pipeline": {"module._model.field.mlp_base.0.weight": ONE}}, "nerfacto"),
    "nerfstudio's NeRF": ({"pipeline": {"_model.field_fine.mlp_base.layers.0.weight": ONE}}, "vanilla NeRF"),
    "nerfstudio's mip-NeRF": (
        {
            "pipeline": {
                "_model.field.mlp_base.layers.0.weight": ONE,
                "_model.field.field_output_density.net.weight": ONE,
            }
        },
        "mip-NeRF",
    ),
    "nerfstudio's TensoRF": ({"pipeline": {"_model.field.density_encoding.plane_coef": ONE}}, "TensoRF"),
    "TensoRF": ({"kwargs": {}, "state_dict": {"density_plane.0": ONE, "density_line.0": ONE}}, "TensoRF"),
    "K-Planes": ({"model": {"field.grids.0.0": ONE, "field.sigma_net.params": ONE}}, "K-Planes"),
    "DirectVoxGO": ({"model_state_dict": {"density.grid": ONE, "k0.grid": ONE}}, "DirectVoxGO"),
    "ngp_pl": ({"state_dict": {"model.xyz_encoder.params": ONE, "model.rgb_net.params": ONE}}, "ngp_pl"),
    "SHINE-Mapping": ({"iters": 9, "feature_octree": {"a": ONE}, "geo_decoder": {"lout.weight": ONE}}, "SHINE"),
    "Co-SLAM, fused": ({"pose": {}, "model": {"embed_fn.params": ONE, "decoder.sdf_net.model.params": ONE}}, "Co-SLAM"),
    "NICE-SLAM": ({"c": {"grid_fine": ONE}, "decoder_state_dict": {"a": ONE}}, "NICE-SLAM"),
    "NeRF": ({"global_step": 1, "network_fn_state_dict": {"pts_linears.0.weight": ONE}}, "NeRF"),
    "torch-ngp's radiance field": ({"model": {"encoder.embeddings": ONE, "sigma_net.0.weight": ONE}}, "torch-ngp"),
    "torch-ngp's distances": ({"model": {"encoder.embeddings": ONE, "backbone.0.weight": ONE}}, "torch-ngp"),
    "torch-ngp's distances, the tensors alone": ({"encoder.params": ONE, "backbone.params": ONE}, "torch-ngp"),
    "Co-SLAM": ({"model": {"decoder.sdf_net.model.0.weight": ONE}}, "Co-SLAM"),
    "iSDF": ({"model_state_dict": {"in_layer.0.weight": ONE, "out_alpha.weight": ONE}}, "iSDF"),
    "NGLOD": ({"features.0.fm": ONE, "louts.0.0.weight": ONE}, "NGLOD"),
    "MonoSDF with a grid": (
        {
            "model_state_dict": {
                "module.implicit_network.encoding.params": ONE,
                "module.implicit_network.lin0.weight_v": ONE,
            }
        },
        "MonoSDF",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_named_with_what_to_do_instead(case: str, tmp_path: Path) -> None:
    values, name = CASES[case]
    torch.save(values, tmp_path / "upload")
    with pytest.raises(FieldFormatError) as caught:
        convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    assert caught.value.reason == "FAMILY_NOT_SUPPORTED"
    assert name in str(caught.value)
    assert "mesh" in str(caught.value)


def test_a_program_of_torchscript_is_named(tmp_path: Path) -> None:
    """As torch writes it: parts of it are compressed."""
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.ReLU())
    with pytest.warns(DeprecationWarning, match="torch.jit"):
        torch.jit.save(torch.jit.trace(network, torch.zeros(2, 3)), tmp_path / "upload")
    with pytest.raises(FieldFormatError, match="ONNX") as caught:
        convert_file(tmp_path / "upload", tmp_path, None, ImportLimits())
    assert caught.value.reason == "ARCHIVE_TORCHSCRIPT"


def test_plenoxels_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "upload.npz", links=np.zeros((2, 2, 2)), density_data=np.ones((4, 1)), sh_data=np.ones((4, 27)))
    with pytest.raises(FieldFormatError, match=r"Plenoxels.*mesh") as caught:
        convert_file(tmp_path / "upload.npz", tmp_path, None, ImportLimits())
    assert caught.value.reason == "FAMILY_NOT_SUPPORTED"
