"""The recording at a path: a folder or file of some layout, or an archive of one."""

from __future__ import annotations

import hashlib
import json
import os
import tarfile
import zipfile
import zlib
from pathlib import Path

from regnf_core.errors import made_folder
from regnf_core.version import __version__
from regnf_data.recordings.layouts import has_layout, read_layout
from regnf_data.recordings.recording import Given, Recording
from regnf_data.recordings.stored import read_stored

_TARS = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")
_CHECKPOINTS = (".ckpt", ".pt", ".pth", ".pkl", ".safetensors")
_IMAGES = (".png", ".tif", ".tiff", ".npy", ".pgm", ".exr")


def open_recording(path: str | os.PathLike[str], given: Given | None = None) -> Recording:
    """The recording in a folder, a file or an archive. No image of a folder is decoded yet.

    Raises DatasetError: DATASET_NOT_RECOGNIZED with what was looked for, and those of the layout's reader; of an
    archive FieldFormatError too.
    """
    return _archive(Path(path), given or Given()) if _is_archive(Path(path)) else read_layout(path, given)


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether a folder or file has the layout of a recording."""
    return has_layout(path) or _is_archive(Path(path))


def _is_archive(path: Path) -> bool:
    """Whether an archive holds depth images or a bag, and no checkpoint."""
    if not path.is_file():
        return False
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as zipped:
                names = zipped.namelist()
        elif path.name.lower().endswith(_TARS):
            with tarfile.open(path) as tarred:
                names = tarred.getnames()
        else:
            return False
    except (OSError, zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error):
        return False
    return not any(name.endswith(_CHECKPOINTS) for name in names) and any(
        name.endswith((".mcap", ".db3", ".bag")) or ("depth" in name.lower() and name.lower().endswith(_IMAGES))
        for name in names
    )


def _archive(path: Path, given: Given) -> Recording:
    """Imported as a service imports it; what was made of an archive is kept in the user's cache."""
    from regnf_core.loading import default_cache_dir
    from regnf_data.recordings.importing import import_recording

    description = given.described().non_default()
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256")
    digest.update(json.dumps([__version__, description], sort_keys=True).encode())
    kept = default_cache_dir().parent / "recordings" / digest.hexdigest()[:32]
    if not (kept / "field.safetensors").is_file():
        with made_folder(kept):
            import_recording(path, kept, description)
    return read_stored(kept / "field.safetensors", path.name)
