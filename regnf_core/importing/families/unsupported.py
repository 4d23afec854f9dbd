"""Families that are recognized but not supported: the refusal names them, and what to give instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import states
from regnf_core.importing.families.wrappers import WRAPPED
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

_MESH = "extract its mesh, and give the mesh"
_DENSITY = "render depth images and fuse them (regnf fuse), or extract its mesh, and give the mesh"


@dataclass(frozen=True)
class _Known:
    """A family by what its checkpoint has: entries at the top, and beginnings of the tensors' names below them."""

    what: str
    instead: str
    top: tuple[str, ...] = ()
    tensors: tuple[str, ...] = ()


def _density(what: str, *tensors: str, top: str | None = None) -> _Known:
    return _Known(f"{what}, a radiance field without distances", _DENSITY, (top,) if top else (), tensors)


_KNOWN = (
    _Known("torch-ngp's", _MESH, ("model",), ("encoder.",)),
    _Known("torch-ngp's", _MESH, (), ("encoder.", "backbone.")),
    _Known("Co-SLAM's", "give the mesh in the run's folder", ("model",), ("decoder.sdf_net.",)),
    _Known("IDR's, VolSDF's or MonoSDF's", _MESH, (), ("implicit_network.",)),
    _Known("iSDF's", _MESH, ("model_state_dict",), ("in_layer.", "out_alpha.")),
    _Known("NGLOD's", _MESH, (), ("features.0.fm", "louts.")),
    _Known(
        "SHINE-Mapping's, an octree whose tables are pickled as an object, and its scale in the settings",
        "give the mesh in the run's folder mesh",
        ("feature_octree", "geo_decoder"),
    ),
    _Known("NICE-SLAM's, grids of occupancies", _MESH, ("c", "decoder_state_dict")),
    _density("nerfstudio's generfacto", "_model.field.mlp_background_color."),
    _density("nerfstudio's vanilla NeRF", "_model.field_fine."),
    _density("nerfstudio's TensoRF", "_model.field.density_encoding."),
    _density("nerfstudio's mip-NeRF", "_model.field.field_output_density."),
    _density("nerfstudio's nerfacto or a model with its names", "_model.field.mlp_base"),
    _density("TensoRF's", "density_line."),
    _density("K-Planes'", "field.grids.", "field.sigma_net."),
    _density("DirectVoxGO's", "density.grid", "k0.grid"),
    _density("ngp_pl's", "model.xyz_encoder."),
    _density("NeRF's", top="network_fn_state_dict"),
)


def refuse(checkpoint: dict[Any, Any], _source: TensorSource, _description: UploadDescription) -> ConvertedField | None:
    """None for a checkpoint of no known family. Raises FieldFormatError (FAMILY_NOT_SUPPORTED) naming a known one."""
    for known in _KNOWN:
        if all(name in checkpoint for name in known.top) and all(_has(checkpoint, part) for part in known.tensors):
            message = f"this is a checkpoint of {known.what}; it is not supported: {known.instead}"
            raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    return None


def _has(checkpoint: dict[Any, Any], part: str) -> bool:
    return any(WRAPPED.sub("", name).startswith(part) for _, state in states(checkpoint) for name in state)
