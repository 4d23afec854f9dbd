"""Archives of a recording: told by the names in them, and unpacked for as long as the recording is used."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
import weakref
import zipfile
from pathlib import Path, PurePosixPath

from regnf_core.errors import DatasetError

_MARKS = (
    "scene_camera.json", "meta_data.json", "transforms.json", "transforms_train.json", "metadata.yaml", "depth.txt",
    "traj.txt", "cameras.txt", "cameras.bin", "pose_graph.json",
)  # fmt: skip
_ENDS = (".mcap", ".db3", ".bag", ".pose.txt", ".log")
_CHECKPOINTS = (".ckpt", ".pt", ".pth")
_MOST_BYTES = 1 << 37


def is_archive(path: Path) -> bool:
    """Whether a file is a zip or tar file, packed or not, of a recording; one with a checkpoint is a training run's."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
        elif ".tar" in path.suffixes or path.suffix in (".tgz", ".tbz2", ".txz"):
            with tarfile.open(path) as packed:
                names = packed.getnames()
        else:
            return False
    except (OSError, zipfile.BadZipFile, tarfile.TarError, EOFError):
        return False
    found = [PurePosixPath(name) for name in names]
    if any(name.suffix in _CHECKPOINTS for name in found):
        return False
    return any(name.name in _MARKS or name.name.endswith(_ENDS) or "depth" in name.name for name in found)


class Kept:
    """The files of an archive are there for as long as this is."""


def unpacked(path: Path) -> tuple[Path, Kept]:
    """The folder in an archive, and what keeps it.

    Raises FieldFormatError with the ARCHIVE_* reasons, DatasetError (DATASET_TOO_LARGE) where there is no room.
    """
    from regnf_data.recordings.importing import inner_folder, kind_of, unpack

    folder, kept = tempfile.mkdtemp(prefix="regnf-recording-"), Kept()
    weakref.finalize(kept, shutil.rmtree, folder, ignore_errors=True)
    target = Path(folder) / path.name.split(".")[0]
    try:
        unpack(path, kind_of(path), target, _MOST_BYTES)
    except OSError as error:
        raise DatasetError(f"{path.name} cannot be unpacked: {error}", reason="DATASET_TOO_LARGE") from error
    return inner_folder(target), kept
