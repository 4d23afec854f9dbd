"""A training run on the user's own disk: its checkpoint, and the settings beside it, packed for the importer.

Nothing is parsed here. Names decide, as in an archive; links that lead out of the run's folder are not followed.
"""

from __future__ import annotations

import itertools
import os
import stat
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from regnf_core.errors import FieldFormatError
from regnf_core.importing.run.opened import MAX_FILES, MAX_SETTINGS_BYTES, choose_checkpoint, choose_settings

_MAX_FILES, _MAX_DEPTH = 50_000, 12
_LEVELS = 4
"""How many folders above a lone checkpoint may be its run's."""
_NEAR = (".", "config", "recording", ".hydra", "LatentCodes")
"""Subfolders in which trainers keep settings."""
_SKIPPED = frozenset({".git", "__pycache__", "wandb", "node_modules", ".venv"})


@dataclass(frozen=True)
class Run:
    """A checkpoint and the settings that belong to it. settings: paths, none of them a folder."""

    checkpoint: Path
    settings: tuple[Path, ...]

    def joined_by(self, file: Path) -> Run:
        """With a file of the dataset, in place of the one of that name."""
        others = (path for path in self.settings if path.name != file.name)
        return Run(self.checkpoint, (*others, file.resolve(strict=True)))


def find_run(folder: Path) -> Run:
    """The run in ``folder``. Raises FieldFormatError: RUN_WITHOUT_CHECKPOINT, AMBIGUOUS_RUN, RUN_TOO_LARGE."""
    root = folder.resolve(strict=True)
    names = sorted(_names_below(root))
    checkpoint = choose_checkpoint(names)
    chosen = choose_settings(names, checkpoint)
    return Run(root / checkpoint, tuple(root / name for name in chosen))


def settings_beside(checkpoint: Path) -> tuple[Path, ...]:
    """The settings that a checkpoint's trainer leaves around it; only their own few folders are looked into."""
    path = checkpoint.resolve(strict=True)
    places = _places_of(path)
    top = places[-1]
    known = (found for folder in places for near in _NEAR for found in _files_in(folder / near))
    names = {str(found.relative_to(top)) for found in known if _stays_in(found, top)}
    own = str(path.relative_to(top))
    return tuple(top / name for name in choose_settings(sorted(names | {own}), own))


def _places_of(checkpoint: Path) -> list[Path]:
    """The folder of a checkpoint and those above it that may be its run's: not a user's home, nor what all may write.

    Who may write there could say how other people's files are read.
    """
    own, *above = list(checkpoint.parents)[:_LEVELS]
    shared = {Path.home(), *Path.home().parents}
    return [
        own,
        *itertools.takewhile(lambda folder: folder not in shared and not folder.stat().st_mode & stat.S_IWOTH, above),
    ]


def pack_settings(run: Run, into: Path) -> Path:
    """A tar file of the run's settings in the folder ``into``. Raises FieldFormatError (SETTINGS_TOO_LARGE)."""
    target = into / "settings.tar"
    top = Path(os.path.commonpath([path.parent for path in run.settings] or [run.checkpoint.parent]))
    if sum(path.stat().st_size for path in run.settings) > MAX_SETTINGS_BYTES:
        message = f"the config files next to {run.checkpoint.name} have more than {MAX_SETTINGS_BYTES} bytes"
        raise FieldFormatError(message, reason="SETTINGS_TOO_LARGE")
    with tarfile.open(target, "w", format=tarfile.GNU_FORMAT, dereference=True) as archive:
        for path in run.settings[:MAX_FILES]:
            archive.add(path, arcname=str(path.relative_to(top)), recursive=False, filter=nameless)
    return target


def nameless(member: tarfile.TarInfo) -> tarfile.TarInfo:
    """Without the user's name and the file's times: the same settings are the same bytes."""
    member.uid = member.gid = member.mtime = 0
    member.uname = member.gname = ""
    return member


def _names_below(root: Path) -> Iterator[str]:
    """Plain files below ``root``, links to files within it included. Raises FieldFormatError (RUN_TOO_LARGE)."""
    waiting, count = [(root, 0)], 0
    while waiting:
        folder, depth = waiting.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                count += 1
                if count > _MAX_FILES:
                    message = f"{root.name} holds more than {_MAX_FILES} files; give only the checkpoint"
                    raise FieldFormatError(message, reason="RUN_TOO_LARGE")
                if entry.is_dir(follow_symlinks=False):
                    if depth < _MAX_DEPTH and entry.name not in _SKIPPED:
                        waiting.append((Path(entry.path), depth + 1))
                elif _stays_in(Path(entry.path), root):
                    yield Path(entry.path).relative_to(root).as_posix()


def _files_in(folder: Path) -> Iterator[Path]:
    if folder.is_dir():
        with os.scandir(folder) as entries:
            yield from (folder / entry.name for entry in itertools.islice(entries, _MAX_FILES))


def _stays_in(path: Path, root: Path) -> bool:
    """Whether ``path`` is a plain file that lies, its links followed, below ``root``."""
    try:
        return path.is_file() and path.resolve(strict=True).is_relative_to(root)
    except (OSError, RuntimeError):
        return False


# A folder on the user's own disk that says where cameras stood: its one file that does, or its poses, packed.

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
        few = itertools.islice(entries, _MOST_LOOKED_AT)
        found = sorted(Path(entry.path) for entry in few if entry.name.lower().endswith(".txt") and entry.is_file())
    if len(found) > _MOST_FILES or sum(text.stat().st_size for text in found) > _MOST_BYTES:
        message = f"{folder} holds more than {_MOST_FILES} texts, or more than {_MOST_BYTES} bytes of them"
        raise FieldFormatError(message, reason="SETTINGS_TOO_LARGE")
    return found
