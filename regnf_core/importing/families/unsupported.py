"""Families that are recognized but not supported: the refusal names them."""

from __future__ import annotations

from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import strip_prefix
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription


def refuse(checkpoint: dict[Any, Any], _source: TensorSource, _description: UploadDescription) -> ConvertedField | None:
    """None for a checkpoint of no known family. Raises FieldFormatError (FAMILY_NOT_SUPPORTED) naming a known one."""
    if not strip_prefix(checkpoint.get("model"), "encoder."):
        return None
    message = "this is a checkpoint of torch-ngp's radiance fields, which have no distances and are not supported"
    raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
