"""An upload opened: a file is what it is; of an archive of a run, its checkpoint and the settings beside it."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.refused import named_file
from regnf_core.importing.containers.sniff import HEAD_BYTES, RUN_ARCHIVES, sniff_format
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, read_members, require_modest
from regnf_core.importing.run.tar_run import MAX_PARTS, TarRun, archive_error, kept
from regnf_core.library_entries import shown_path

# Which file of a run is its checkpoint: the newest step by the trainer's own naming, never by the files' times.

_TIERS = (
    (".ckpt", ".pth.tar", ".pth", ".pt"),
    (".safetensors", ".onnx", ".npz", ".nvblx", ".db", ".sqlite", ".ingp", ".msgpack"),
    (".urdf",),
    (
        *(".step", ".stp", ".3mf", ".usd", ".usda", ".usdc", ".usdz"),
        *(".glb", ".gltf", ".ply", ".obj", ".stl", ".pcd", ".xyz", ".las", ".laz", ".e57", ".splat", ".ksplat", ".spz"),
    ),
)
"""What may hold a field, by the ends of names. A run with files of an earlier line has its field in those."""
_TENSORS_ELSEWHERE = "optimizerparameters schedulerparameters latentcodes reconstructions normalizationparameters"
_OTHER_FOLDERS = {
    *_TENSORS_ELSEWHERE.split(),
    "sdfsamples",
    "tensorboard",
    "wandb",
    "code",
    ".git",
    ".hydra",
    "__macosx",
}
"""Folders in which trainers keep other tensors than the field's, in lower case."""
_OTHER_FILES = re.compile(
    r"cameras.*\.npz|.*(optimizer|optim|scheduler|opt_state).*|events\.out\..*|\._.*", re.IGNORECASE
)
_NUMBER = re.compile(r"\d+")
_OF_TRAINING = re.compile(r"ckpt|checkpoint|model|epoch|step|iter|(?<![a-z])ep(?=[^a-z]*\d)", re.IGNORECASE)
"""In a name or its folder's: the numbers are steps of a training, and not which of several objects it is."""
_STEP_WORD = re.compile(r"(?<![a-z])(epochs?|ep|steps?|iterations?|iters?|it)(?=[^a-z]*#)", re.IGNORECASE)
_STANDING = {"best": 1, "current": 3, "last": 4, "latest": 4, "final": 5}
"""Words in place of a number: where they stand beside numbered files, which have 2."""
_STANDING_WORD = re.compile(r"(?<![a-z])(best|current|last|latest|final)(?![a-z])", re.IGNORECASE)
_TRAINED_SPLATS = re.compile(r"(?:^|/)point_cloud/iteration_([0-9]{1,18})/[^/]+$")
"""Where the trainers of 3DGS and 2DGS put their steps; the cloud beside them is what they began with."""
TRAINED_CAMERAS = "cameras.json"
"""Beside such steps: the cameras of the training, in the same frame."""
_SOG_TEXT, _SOG_IMAGE = "meta.json", "means_l.webp"
_SHOWN = 6


@dataclass(frozen=True)
class _Candidate:
    """A file that may hold a field. Files of one ``series`` are one training at several times."""

    name: str
    series: tuple[str, str, str]
    age: tuple[int, tuple[int, ...]]


def choose_checkpoint(names: Iterable[str]) -> str:
    """The newest checkpoint among ``names``, paths below the run's folder with ``/`` between their parts.

    Raises FieldFormatError: RUN_WITHOUT_CHECKPOINT, or AMBIGUOUS_RUN where several files are no steps of one training.
    """
    tier = _first_tier(names)
    if not tier:
        told = next((f"{shown_path(name)} is {what}" for name in names if (what := named_file(name))), None)
        ends = " ".join(end for ends in _TIERS for end in ends)
        message = told or f"the importer looked for {ends}"
        raise FieldFormatError(f"no file of the run is a checkpoint; {message}", reason="RUN_WITHOUT_CHECKPOINT")
    tier = [one for one in tier if _TRAINED_SPLATS.search(one.name)] or tier
    if len({candidate.series for candidate in tier}) > 1:
        shown = ", ".join(sorted(shown_path(candidate.name) for candidate in tier)[:_SHOWN])
        message = f"{len(tier)} files of the run may be the checkpoint: {shown}; give one of them alone"
        raise FieldFormatError(message, reason="AMBIGUOUS_RUN")
    return max(tier, key=lambda candidate: (candidate.age, candidate.name)).name


def _first_tier(names: Iterable[str]) -> list[_Candidate]:
    tiers: tuple[list[_Candidate], ...] = tuple([] for _ in _TIERS)
    for name in names:
        path = PurePosixPath(name)
        if _OTHER_FILES.fullmatch(path.name) or any(part.lower() in _OTHER_FOLDERS for part in path.parts[:-1]):
            continue
        for tier, ends in zip(tiers, _TIERS, strict=True):
            end = next((end for end in ends if path.name.lower().endswith(end)), None)
            if end is not None and len(path.name) > len(end):
                tier.append(_candidate(path, end))
                break
    return next((tier for tier in tiers if tier), [])


def _candidate(path: PurePosixPath, end: str) -> _Candidate:
    stem = path.name[: -len(end)]
    if found := _TRAINED_SPLATS.search(str(path)):
        return _Candidate(str(path), (str(path.parent.parent), stem, end), (2, (int(found[1]),)))
    if not _OF_TRAINING.search(f"{path.parent.name}/{stem}"):
        return _Candidate(str(path), (str(path.parent), stem, end), (0, ()))
    words = [word.lower() for word in _STANDING_WORD.findall(stem)]
    numbers = tuple(int(number) for number in _NUMBER.findall(stem)[:8] if len(number) <= 18)
    standing = _STANDING[words[-1]] if words else 2 if numbers else 0
    nameless = _STEP_WORD.sub("", _NUMBER.sub("#", _STANDING_WORD.sub("", stem)))
    series = re.sub(r"[^a-z]+", "_", nameless.lower()).strip("_")
    return _Candidate(str(path), (str(path.parent), series, end), (standing, numbers[::-1]))


# A run in a zip file, read as strictly as a checkpoint's own zip; but folders and deflated members are allowed.


class ZipRun:
    """Members of one zip file by name. ``most`` caps the bytes of those that are unpacked."""

    def __init__(self, data: memoryview, members: list[Member], most: int) -> None:
        self._data, self._most = data, most
        self._members = {member.name: member for member in members if not member.name.endswith("/")}
        if any(name.count("/") >= MAX_PARTS for name in self._members):
            raise archive_error("a member is in too many nested folders", "ARCHIVE_ENTRY_NAME")
        self.sizes = {name: member.size for name, member in self._members.items()}
        """Each member's size in bytes, as the archive claims it."""

    def take(self, names: Collection[str], folder: Path) -> dict[str, memoryview]:
        """The members of these names. Raises FieldFormatError: ARCHIVE_TOO_LARGE, ARCHIVE_DEFLATE_MALFORMED,
        ARCHIVE_CRC_MISMATCH.
        """
        wanted = [self._members[name] for name in names]
        require_modest(sum(m.size for m in wanted), sum(m.packed_size for m in wanted), self._most)
        return {m.name: m.content(self._data, lambda pieces, size: kept(pieces, size, folder)) for m in wanted}


# Which files of a run are its trainer's settings: known names at known places around the checkpoint, nearest first.

_LEVELS = 4
"""How many folders above the checkpoint's own may be the run's."""
DATA_FILES = ("dataparser_transforms.json", "meta_data.json", "transforms.json", "cameras_sphere.npz")
"""What trainers keep beside the images: taken from anywhere in the run where there is one of the name."""
RUN_FILES = (
    *("config.yml", "config.yaml", "config.json", "parsed.yaml", "config/parsed.yaml", "config/config.yaml"),
    *("recording/*.conf", "*.conf", "specs.json", ".hydra/config.yaml", "run.yaml", "run.yml", "params.yaml"),
    *("hparams.yaml", *DATA_FILES),
)
"""Below one of the folders from the checkpoint's own upwards."""
MAX_FILES = 32


def choose_settings(names: Collection[str], checkpoint: str) -> tuple[str, ...]:
    """The settings among ``names`` that belong to ``checkpoint``, at most one a name, the nearest."""
    here = PurePosixPath(checkpoint)
    known = [name for name in names if name != checkpoint]
    chosen: dict[str, str] = {}
    own = TRAINED_CAMERAS if _TRAINED_SPLATS.search(checkpoint) else f"LatentCodes/{here.stem}.pth"
    for folder in list(here.parents)[:_LEVELS]:
        for pattern in (*RUN_FILES, own):
            for name in sorted(known):
                path = PurePosixPath(name)
                if path.is_relative_to(folder) and _fits(path.relative_to(folder), pattern):
                    chosen.setdefault(_role(path), name)
    for wanted in DATA_FILES:
        found = [name for name in known if PurePosixPath(name).name == wanted]
        if len(found) == 1:
            chosen.setdefault(wanted, found[0])
    scales = [name for name in known if "NormalizationParameters" in PurePosixPath(name).parts]
    if len(scales) == 1:
        chosen.setdefault("normalization", scales[0])
    return tuple(chosen.values())[:MAX_FILES]


def _fits(path: PurePosixPath, pattern: str) -> bool:
    parts = pattern.split("/")
    return len(parts) == len(path.parts) and all(map(fnmatch.fnmatchcase, path.parts, parts))


def _role(path: PurePosixPath) -> str:
    """What there may be one of."""
    if path.suffix == ".conf":
        return ".conf"
    if path.parent.name == "LatentCodes":
        return "codes"
    return path.name


MAX_SETTINGS_BYTES = 64 << 20
"""All settings together: latent codes of a thousand shapes are the largest."""
_USD = (".usd", ".usda", ".usdc")
OTHER_FILES = {".gltf": (".bin",), ".glb": (".bin",), ".json": (".webp",), **dict.fromkeys(_USD, _USD)}
"""By the end of a mesh's name, the ends of the names of files that it may refer to."""


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
    members: list[Member] | None = None
    """Of a checkpoint or arrays in a zip file: what it lists, so that it is read once."""


def open_upload(data: memoryview, folder: Path, most: int) -> OpenedUpload:
    """``data`` itself, or what is in it if it is an archive of a run: ``most`` bytes at most, unpacked to ``folder``.

    Raises FieldFormatError: AMBIGUOUS_RUN, RUN_WITHOUT_CHECKPOINT, ARCHIVE_NESTED, SETTINGS_TOO_LARGE, FILE_TRUNCATED
    and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    archive, members = _opened(data, most)
    if archive is None:
        return OpenedUpload(data, members=members)
    name = _sog(archive.sizes) or choose_checkpoint(archive.sizes)
    settings = choose_settings(archive.sizes, name)
    _require_few(archive, settings)
    siblings = _siblings(archive, name) or _meshes(archive, name, folder)
    taken = archive.take({name, *settings, *siblings.values()}, folder)
    nested, members = _opened(taken[name], most)
    if nested is not None:
        raise archive_error(f"{shown_path(name)} is an archive in the archive; give it alone", "ARCHIVE_NESTED")
    return OpenedUpload(
        taken[name],
        name,
        tuple(SettingsFile(each, taken[each]) for each in settings),
        {seen: taken[each] for seen, each in siblings.items()},
        members,
    )


def open_settings(
    data: memoryview, name: str, folder: Path, most: int, files: int = MAX_FILES
) -> tuple[SettingsFile, ...]:
    """The one file of settings of the name ``name``, or the ``files`` at most in an archive of settings.

    Raises as ``open_upload``.
    """
    archive = None if name.lower().endswith(".npz") else _opened(data, most)[0]
    if archive is None:
        if len(data) > MAX_SETTINGS_BYTES:
            raise _too_large(f"the settings have {len(data)} bytes")
        return (SettingsFile(name, data),)
    if len(archive.sizes) > files:
        raise _too_large(f"{len(archive.sizes)} files; at most {files} are allowed")
    _require_few(archive, tuple(archive.sizes))
    return tuple(SettingsFile(each, content) for each, content in archive.take(archive.sizes, folder).items())


def _opened(data: memoryview, most: int) -> tuple[ZipRun | TarRun | None, list[Member] | None]:
    """The archive of a run in ``data``, or None for any other file; and what any sound zip file lists."""
    kind = sniff_format(bytes(data[:HEAD_BYTES]))
    if kind in ("torch-zip", "npz"):
        try:
            members = read_members(data, (STORED, DEFLATED), folders=True)
        except FieldFormatError:
            return None, None
        return ZipRun(data, members, most) if _is_run(members, kind) else None, members
    if kind == "zip":
        return ZipRun(data, members := read_members(data, (STORED, DEFLATED), folders=True), most), members
    return TarRun(data, None if kind == "tar" else kind, most) if kind in RUN_ARCHIVES else None, None


def _is_run(members: list[Member], kind: str) -> bool:
    """Whether a zip whose first member's name would fit a checkpoint or arrays holds other objects too."""
    names = [member.name for member in members]
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
    ends = OTHER_FILES.get(path.suffix.lower(), ())
    near = [each for each in map(PurePosixPath, archive.sizes) if each.is_relative_to(path.parent) and each != path]
    return {str(each.relative_to(path.parent)): str(each) for each in near if each.suffix.lower() in ends}


def _meshes(archive: ZipRun | TarRun, name: str, folder: Path) -> dict[str, str]:
    """Names in the archive of the meshes of a robot, by the names that it gives them."""
    if not name.lower().endswith(".urdf"):
        return {}
    from regnf_core.importing.meshes.urdf import endings, mesh_names

    names = sorted(archive.sizes)
    found = {
        mesh: [each for end in endings(mesh) for each in names if f"/{each}".endswith(f"/{end}")]
        for mesh in mesh_names(archive.take({name}, folder)[name])
    }
    return {mesh: fitting[0] for mesh, fitting in found.items() if fitting}


def _sog(names: Collection[str]) -> str | None:
    """The text of Gaussian splats whose numbers are in images beside it (SOG)."""
    texts = [str(path) for path in map(PurePosixPath, names) if path.name == _SOG_TEXT]
    return next((text for text in texts if str(PurePosixPath(text).parent / _SOG_IMAGE) in names), None)
