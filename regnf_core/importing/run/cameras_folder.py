"""A folder on the user's own disk that says where cameras stood: its one file that does, or its poses, packed."""

from __future__ import annotations

import os
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from regnf_core.errors import FieldFormatError
from regnf_core.importing.run.folder import nameless

_KNOWN = ("transforms.json", "transforms_train.json", "meta_data.json", "cameras_sphere.npz")
_MOST_FILES, _MOST_BYTES = 16_000, 64 << 20
_MOST_LOOKED_AT = 200_000


@contextmanager
def packed_cameras(path: Path) -> Iterator[Path]:
    """The file ``path`` itself; of a folder, its ``transforms.json`` or the like, else a tar file of its texts.

    Images are left out. Raises FieldFormatError: CAMERAS_NOT_RECOGNIZED, SETTINGS_TOO_LARGE.
    """
    if not path.is_dir():
        yield path
        return
    known = next((path / name for name in _KNOWN if (path / name).is_file()), None)
    if known is not None:
        yield known
        return
    texts = _texts(path)
    if not texts:
        expected = f"{', '.join(_KNOWN)} or *.txt"
        raise FieldFormatError(f"{path} holds no cameras: expected {expected}", reason="CAMERAS_NOT_RECOGNIZED")
    with TemporaryDirectory(prefix="cameras-") as folder:
        target = Path(folder) / "cameras.tar"
        with tarfile.open(target, "w", format=tarfile.GNU_FORMAT, dereference=True) as archive:
            for text in texts:
                archive.add(text, arcname=text.name, recursive=False, filter=nameless)
        yield target


def _texts(folder: Path) -> list[Path]:
    """Its plain files that end in .txt, by name."""
    with os.scandir(folder) as entries:
        few = (entry for entry, _ in zip(entries, range(_MOST_LOOKED_AT), strict=False))
        found = sorted(Path(entry.path) for entry in few if entry.name.lower().endswith(".txt") and entry.is_file())
    if len(found) > _MOST_FILES or sum(text.stat().st_size for text in found) > _MOST_BYTES:
        message = f"{folder} holds more than {_MOST_FILES} texts, or more than {_MOST_BYTES} bytes of them"
        raise FieldFormatError(message, reason="SETTINGS_TOO_LARGE")
    return found
