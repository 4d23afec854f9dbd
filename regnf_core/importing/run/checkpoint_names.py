"""Which file of a run is its checkpoint: the newest step by the trainer's own naming, never by the files' times."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

from regnf_core.errors import FieldFormatError
from regnf_core.labels import shown_path

_TIERS = (
    (".ckpt", ".pth.tar", ".pth", ".pt"),
    (".safetensors", ".onnx", ".npz", ".nvblx", ".db", ".sqlite"),
    (".glb", ".gltf", ".ply", ".obj", ".stl", ".off", ".dae", ".pcd", ".xyz"),
)
"""What may hold a field, by the ends of names. A run with files of an earlier line has its field in those."""
_OTHER_FOLDERS = frozenset(
    {
        "optimizerparameters",
        "schedulerparameters",
        "latentcodes",
        "reconstructions",
        "normalizationparameters",
        "sdfsamples",
        "tensorboard",
        "wandb",
        "code",
        ".git",
        ".hydra",
        "__macosx",
    }
)
"""Folders in which trainers keep other tensors than the field's, in lower case."""
_OTHER_FILES = re.compile(
    r"cameras.*\.npz|.*(optimizer|optim|scheduler|opt_state).*|events\.out\..*|\._.*", re.IGNORECASE
)
_NUMBER = re.compile(r"\d+")
_OF_TRAINING = re.compile(r"ckpt|checkpoint|model|epoch|step|iter|(?<![a-z])ep(?=[^a-z]*\d)", re.IGNORECASE)
"""In a name or its folder's: the numbers are steps of a training, and not which of several things it is."""
_STEP_WORD = re.compile(r"(?<![a-z])(epochs?|ep|steps?|iterations?|iters?|it)(?=[^a-z]*#)", re.IGNORECASE)
_STANDING = {"best": 1, "current": 3, "last": 4, "latest": 4, "final": 5}
"""Words in place of a number: where they stand beside numbered files, which have 2."""
_STANDING_WORD = re.compile(r"(?<![a-z])(best|current|last|latest|final)(?![a-z])", re.IGNORECASE)
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
        ends = " ".join(end for ends in _TIERS for end in ends)
        raise FieldFormatError(
            f"no file of the run is a checkpoint; looked for {ends}", reason="RUN_WITHOUT_CHECKPOINT"
        )
    if len({candidate.series for candidate in tier}) > 1:
        shown = ", ".join(sorted(shown_path(candidate.name) for candidate in tier)[:_SHOWN])
        message = f"{len(tier)} files of the run may be the checkpoint: {shown}; give one of them by itself"
        raise FieldFormatError(message, reason="AMBIGUOUS_RUN")
    return max(tier, key=lambda candidate: (candidate.age, candidate.name)).name


def _first_tier(names: Iterable[str]) -> list[_Candidate]:
    tiers: tuple[list[_Candidate], ...] = ([], [], [])
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
    if not _OF_TRAINING.search(f"{path.parent.name}/{stem}"):
        return _Candidate(str(path), (str(path.parent), stem, end), (0, ()))
    words = [word.lower() for word in _STANDING_WORD.findall(stem)]
    numbers = tuple(int(number) for number in _NUMBER.findall(stem)[:8] if len(number) <= 18)
    standing = _STANDING[words[-1]] if words else 2 if numbers else 0
    nameless = _STEP_WORD.sub("", _NUMBER.sub("#", _STANDING_WORD.sub("", stem)))
    series = re.sub(r"[^a-z]+", "_", nameless.lower()).strip("_")
    return _Candidate(str(path), (str(path.parent), series, end), (standing, numbers[::-1]))
