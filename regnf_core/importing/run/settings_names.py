"""Which files of a run are its trainer's settings: known names at known places round the checkpoint, nearest first."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection
from pathlib import PurePosixPath

_LEVELS = 4
"""How many folders above the checkpoint's own may be the run's."""
RUN_FILES = (
    "config.yml",
    "config.yaml",
    "config.json",
    "parsed.yaml",
    "config/parsed.yaml",
    "config/config.yaml",
    "recording/*.conf",
    "*.conf",
    "specs.json",
    ".hydra/config.yaml",
    "run.yaml",
    "run.yml",
    "params.yaml",
    "hparams.yaml",
    "dataparser_transforms.json",
    "meta_data.json",
    "transforms.json",
    "cameras_sphere.npz",
)
"""Below one of the folders from the checkpoint's own upwards."""
DATA_FILES = ("dataparser_transforms.json", "meta_data.json", "transforms.json", "cameras_sphere.npz")
"""What trainers keep beside the images: taken from anywhere in the run where there is one of the name."""
MAX_FILES = 32


def choose_settings(names: Collection[str], checkpoint: str) -> tuple[str, ...]:
    """The settings among ``names`` that belong to ``checkpoint``, at most one a name, the nearest."""
    here = PurePosixPath(checkpoint)
    known = [name for name in names if name != checkpoint]
    chosen: dict[str, str] = {}
    for folder in list(here.parents)[:_LEVELS]:
        for pattern in run_patterns(here.stem):
            for name in sorted(known):
                path = PurePosixPath(name)
                if path.is_relative_to(folder) and _matches(path.relative_to(folder), pattern):
                    chosen.setdefault(_role(path), name)
    for wanted in DATA_FILES:
        found = [name for name in known if PurePosixPath(name).name == wanted]
        if len(found) == 1:
            chosen.setdefault(wanted, found[0])
    scales = [name for name in known if "NormalizationParameters" in PurePosixPath(name).parts]
    if len(scales) == 1:
        chosen.setdefault("normalization", scales[0])
    return tuple(chosen.values())[:MAX_FILES]


def run_patterns(stem: str) -> tuple[str, ...]:
    """Where the settings of the checkpoint of the name ``stem`` lie, below one of its folders."""
    return (*RUN_FILES, f"LatentCodes/{stem}.pth")


def _matches(path: PurePosixPath, pattern: str) -> bool:
    parts = pattern.split("/")
    return len(parts) == len(path.parts) and all(map(fnmatch.fnmatchcase, path.parts, parts))


def _role(path: PurePosixPath) -> str:
    """What there may be one of."""
    if path.suffix == ".conf":
        return ".conf"
    if path.parent.name == "LatentCodes":
        return "codes"
    return path.name
