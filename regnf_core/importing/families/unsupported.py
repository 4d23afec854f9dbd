"""Families that are told apart but not taken yet: refused by name, which helps more than "not recognised"."""

from __future__ import annotations

from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.tensors import TensorSource
from regnf_core.importing.upload_description import UploadDescription

_BY_KEY = {
    "sdf_network_fine": "NeuS",
    "neural_points": "PIN-SLAM",
    "latent_codes": "DeepSDF",
    "model_state_dict": "DeepSDF or iSDF",
}
_BY_PREFIX = (
    ("state_dict", "model.geometry.", "instant-nsr-pl"),
    ("model", "module.neural_sdf.", "Neuralangelo"),
    ("model", "encoder.", "torch-ngp"),
    (None, "net.net.", "SIREN"),
)


def refuse(checkpoint: dict[Any, Any], _source: TensorSource, _description: UploadDescription) -> ConvertedField | None:
    """None for a checkpoint of no known family. Raises FieldFormatError (FAMILY_NOT_SUPPORTED) naming a known one."""
    name = next((family for key, family in _BY_KEY.items() if key in checkpoint), None)
    for key, prefix, family in _BY_PREFIX:
        weights = checkpoint if key is None else checkpoint.get(key)
        if isinstance(weights, dict) and any(isinstance(k, str) and k.startswith(prefix) for k in weights):
            name = name or family
    if name is None:
        return None
    raise FieldFormatError(f"this is a {name} checkpoint, which is not supported", reason="FAMILY_NOT_SUPPORTED")
