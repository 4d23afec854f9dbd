"""The blob store that the settings name."""

from __future__ import annotations

from regnf_state.blobs.base import BlobStore
from regnf_state.blobs.local import LocalBlobStore
from regnf_state.settings import Settings


def open_blobs(settings: Settings, wait_s: float, existing: bool = False) -> BlobStore:
    """A local folder or an object store, which is waited for when it is away, ``wait_s`` seconds at most.

    ``existing``: a folder is not made. One that was there a moment ago is away, and another must not take its place.
    """
    if settings.storage_url is None:
        return LocalBlobStore(settings.blob_dir, wait_s, existing)
    from regnf_state.blobs.cache import FileCache
    from regnf_state.blobs.object_store import ObjectBlobStore

    cache = FileCache(settings.field_cache_dir, settings.field_cache_bytes)
    return ObjectBlobStore(settings.storage_url, wait_s, cache)
