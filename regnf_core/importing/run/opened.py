"""An upload opened: a file is what it is; of an archive of a run, its checkpoint and the settings beside it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, RUN_ARCHIVES, sniff_format
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, read_members
from regnf_core.importing.run.checkpoint_names import choose_checkpoint
from regnf_core.importing.run.settings_names import MAX_FILES, choose_settings
from regnf_core.importing.run.tar_run import TarRun
from regnf_core.importing.run.unpacking import archive_error
from regnf_core.importing.run.zip_run import ZipRun
from regnf_core.labels import shown_path

MAX_SETTINGS_BYTES = 64 << 20
"""All settings together: latent codes of a thousand shapes are the largest."""
_WITH_OTHER_FILES = frozenset({".gltf", ".glb"})
_OTHER_ENDS = frozenset({".bin"})


@dataclass(frozen=True)
class SettingsFile:
    """One file of a trainer's settings. name: below the run's folder, with ``/`` between its parts."""

    name: str
    data: memoryview


@dataclass(frozen=True)
class OpenedUpload:
    """What an import is made from."""

    data: memoryview
    """The checkpoint's bytes."""
    name: str | None = None
    """Its name in the archive, if there was one."""
    settings: tuple[SettingsFile, ...] = ()
    siblings: dict[str, memoryview] = field(default_factory=dict)
    """Of a mesh in an archive, the files that it may refer to, by their names seen from its own folder."""


def open_upload(data: memoryview, folder: Path, most: int) -> OpenedUpload:
    """``data`` itself, or what is in it if it is an archive of a run: ``most`` bytes at most, unpacked to ``folder``.

    Raises FieldFormatError: AMBIGUOUS_RUN, RUN_WITHOUT_CHECKPOINT, ARCHIVE_NESTED, SETTINGS_TOO_LARGE, FILE_TRUNCATED
    and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    archive = _opened(data, most)
    if archive is None:
        return OpenedUpload(data)
    name = choose_checkpoint(archive.sizes)
    settings = choose_settings(archive.sizes, name)
    _require_few(archive, settings)
    siblings = _siblings(archive, name)
    taken = archive.take({name, *settings, *siblings.values()}, folder)
    if _opened(taken[name], most) is not None:
        raise archive_error(f"{shown_path(name)} is an archive in the archive; give it by itself", "ARCHIVE_NESTED")
    return OpenedUpload(
        taken[name],
        name,
        tuple(SettingsFile(each, taken[each]) for each in settings),
        {seen: taken[each] for seen, each in siblings.items()},
    )


def open_settings(
    data: memoryview, name: str, folder: Path, most: int, files: int = MAX_FILES
) -> tuple[SettingsFile, ...]:
    """The one file of settings of the name ``name``, or the ``files`` at most in an archive of settings.

    Raises as ``open_upload``.
    """
    archive = None if name.lower().endswith(".npz") else _opened(data, most)
    if archive is None:
        if len(data) > MAX_SETTINGS_BYTES:
            raise _too_large(f"the settings have {len(data)} bytes")
        return (SettingsFile(name, data),)
    if len(archive.sizes) > files:
        raise _too_large(f"{len(archive.sizes)} files; at most {files} are read")
    _require_few(archive, tuple(archive.sizes))
    return tuple(SettingsFile(each, content) for each, content in archive.take(archive.sizes, folder).items())


def _opened(data: memoryview, most: int) -> ZipRun | TarRun | None:
    """The archive of a run in ``data``, or None for any other file."""
    head = bytes(data[:HEAD_BYTES])
    kind = sniff_format(head)
    if kind in ("torch-zip", "npz") and _is_run(data, kind):
        kind = "zip"
    if kind not in RUN_ARCHIVES:
        return None
    if kind == "zip":
        return ZipRun(data, most)
    return TarRun(data, None if kind == "tar" else kind, most)


def _is_run(data: memoryview, kind: str) -> bool:
    """Whether a zip whose first member's name would fit a checkpoint or arrays holds other things too."""
    try:
        names = [member.name for member in read_members(data, (STORED, DEFLATED), folders=True)]
    except FieldFormatError:
        return False
    if kind == "npz":
        return any("/" in name or not name.endswith(".npy") for name in names)
    below = [name.partition("/")[2] for name in names]
    return "data.pkl" not in below and any(PurePosixPath(name).suffix for name in below if not name.startswith("code/"))


def _require_few(archive: ZipRun | TarRun, names: tuple[str, ...]) -> None:
    if sum(archive.sizes[name] for name in names) > MAX_SETTINGS_BYTES:
        raise _too_large(f"the settings have more than {MAX_SETTINGS_BYTES} bytes")


def _too_large(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="SETTINGS_TOO_LARGE")


def _siblings(archive: ZipRun | TarRun, name: str) -> dict[str, str]:
    """Names in the archive by their names as a mesh in it would write them."""
    path = PurePosixPath(name)
    if path.suffix.lower() not in _WITH_OTHER_FILES:
        return {}
    near = [each for each in map(PurePosixPath, archive.sizes) if each.is_relative_to(path.parent) and each != path]
    return {str(each.relative_to(path.parent)): str(each) for each in near if each.suffix.lower() in _OTHER_ENDS}
