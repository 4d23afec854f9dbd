"""The blob store that the settings name."""

from __future__ import annotations

from service.blobs import BlobStore
from service.local_blobs import LocalBlobStore
from service.settings import Settings


def open_blobs(settings: Settings, patience_s: float, existing: bool = False) -> BlobStore:
    """A local folder or an object store, which is waited for when it is away, ``patience_s`` seconds at most.

    ``existing``: a folder is not made. One that was there a moment ago is away, and another must not take its place.
    """
    if settings.storage_url is None:
        return LocalBlobStore(settings.blob_dir, patience_s, existing)
    from service.file_cache import FileCache
    from service.object_blobs import ObjectBlobStore

    cache = FileCache(settings.field_cache_dir, settings.field_cache_bytes)
    return ObjectBlobStore(settings.storage_url, patience_s, cache)
