"""The blob store that the settings name."""

from __future__ import annotations

from service.blobs import BlobStore
from service.local_blobs import LocalBlobStore
from service.settings import Settings


def open_blobs(settings: Settings, patience_s: float) -> BlobStore:
    """A local folder, or an object store whose failing requests are repeated for ``patience_s`` seconds."""
    if settings.storage_url is None:
        return LocalBlobStore(settings.blob_dir)
    from service.file_cache import FileCache
    from service.object_blobs import ObjectBlobStore

    cache = FileCache(settings.field_cache_dir, settings.field_cache_bytes)
    return ObjectBlobStore(settings.storage_url, patience_s, cache)
