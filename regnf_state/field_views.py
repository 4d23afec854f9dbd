"""Where the mesh and the picture of a field lie, which workers make once the field is ready."""

from __future__ import annotations

from regnf_core.field_views import MESH_NAMES, PICTURE_NAME
from regnf_state.blobs.base import BlobStore


def view_key(reference: str, name: str) -> str:
    """Where what people look at of a field lies."""
    return f"fields/{reference}/{name}"


def delete_views(blobs: BlobStore, reference: str) -> None:
    """Delete what people look at of a field."""
    for name in (PICTURE_NAME, *MESH_NAMES):
        blobs.delete(view_key(reference, name))
