"""From a trainer's settings to a description: the first trainer that knows a file says what its keys mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.legacy_container import read_archive, read_legacy
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.pickle.pickle_machine import TensorRef
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.run.opened import MAX_SETTINGS_BYTES, SettingsFile
from regnf_core.importing.settings.documents import read_documents
from regnf_core.importing.settings.facts import Facts
from regnf_core.importing.settings.keys import Keys, malformed
from regnf_core.importing.settings.said import Said
from regnf_core.importing.settings.trainers import hash_grids, layers
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.library_entries import shown_path

# One shape's latent code out of a file of codes beside the settings, through the importer's own reader of pickles.

_MAX_CODE = 512


def latent_code(file: SettingsFile, index: int) -> tuple[list[float], int]:
    """The code ``index`` of the file, and how many there are.

    Raises FieldFormatError: SETTINGS_MALFORMED, INVALID_DESCRIPTION for an index beyond them, and what the readers of
    torch.save's files raise.
    """
    kind = sniff_format(bytes(file.data[:HEAD_BYTES]))
    if kind == "torch-zip":
        archive = read_archive(file.data)
        values, source = read_pickle(archive.read("data.pkl")), TensorSource(archive, MAX_SETTINGS_BYTES)
    elif kind == "torch-legacy":
        values, legacy = read_legacy(file.data)
        source = TensorSource(legacy, MAX_SETTINGS_BYTES)
    else:
        raise malformed(f"{shown_path(file.name)}: not a file of torch.save")
    stored = values.get("latent_codes") if isinstance(values, dict) else None
    if not isinstance(stored, (dict, TensorRef)):
        raise malformed(f"{shown_path(file.name)}: no latent_codes")
    codes = source.array("latent_codes", lookup(stored, "weight") if isinstance(stored, dict) else stored)
    if codes.ndim == 3 and codes.shape[1] == 1:
        codes = codes[:, 0]
    if codes.ndim != 2 or not 1 <= codes.shape[1] <= _MAX_CODE or not len(codes):
        raise malformed(f"{shown_path(file.name)}: latent_codes of the shape {codes.shape}")
    if index >= len(codes):
        message = f"description.latent_index: {index}, but {file.name} has {len(codes)} codes, counted from 0"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
    return [float(number) for number in codes[index]], len(codes)


_MAX_WHY = 400
_PARTS = ("hash", "positional_encoding", "color")
"""Entries of a description that have entries of their own, which settings say."""


@dataclass(frozen=True)
class Trainer:
    """knows: whether a file is one of its · translate: says what the file's keys mean."""

    name: str
    knows: Callable[[Keys], bool]
    translate: Callable[[Keys, Said], None]


def _has(path: str, beside: str = "") -> Callable[[Keys], bool]:
    return lambda keys: isinstance(keys.find(path), dict) and (not beside or keys.has(beside))


TRAINERS = (
    Trainer("nerfstudio", hash_grids.is_radiance, hash_grids.radiance),
    Trainer("nerfstudio", hash_grids.is_nerfstudio, hash_grids.studio),
    Trainer("sdfstudio", hash_grids.is_studio, hash_grids.studio),
    Trainer("instant-nsr-pl", _has(hash_grids.NSR_ENCODING), hash_grids.instant_nsr_pl),
    Trainer("Neuralangelo", _has(hash_grids.ANGELO_ENCODING), hash_grids.neuralangelo),
    Trainer("NeuS", _has(layers.NEUS_NETWORK), layers.neus),
    Trainer("DeepSDF", _has(layers.DEEPSDF_NETWORK, "CodeLength"), layers.deepsdf),
    Trainer("PIN-SLAM", _has("neuralpoints"), layers.pin_slam),
    Trainer("a network of sines", layers.names_frequency, layers.sines),
    Trainer("a map of truncated distances", layers.names_truncation, layers.fusion),
)


@dataclass(frozen=True)
class Settings:
    """What a run's settings say. Empty where there are none, or none that is known."""

    trainer: str | None = None
    files: tuple[str, ...] = ()
    """Names of those that counted."""
    values: dict[str, Any] = field(default_factory=dict)
    """Entries of an UploadDescription, as plain values."""
    why: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def report(self) -> dict[str, Any] | None:
        """For the import's report: flat, and without long values."""
        if self.trainer is None:
            return None
        used = {name: value for name, value in _flat(self.values).items() if not isinstance(value, list)}
        return {"trainer": self.trainer, "files": list(self.files), "used": used}


def translate_settings(
    files: tuple[SettingsFile, ...], facts: Facts, description: UploadDescription, required: bool
) -> Settings:
    """What ``files`` say about a checkpoint of which ``facts`` are known. required: refuse files that nobody knows.

    Raises FieldFormatError: the SETTINGS_* reasons, FAMILY_NOT_SUPPORTED for a setting that makes another function.
    """
    if not files:
        return Settings()
    documents = read_documents(files)
    for trainer in TRAINERS:
        keys = next(filter(trainer.knows, documents.mappings()), None)
        if keys is not None:
            said = Said(trainer.name, facts, documents)
            trainer.translate(keys, said)
            _choose_code(description, said)
            return _settings(said)
    names = ", ".join(PurePosixPath(file.name).name[:60] for file in files[:6])
    message = f"no config file of a known trainer in {names}"
    if required:
        raise FieldFormatError(message, reason="SETTINGS_NOT_RECOGNIZED")
    return Settings(warnings=(f"SETTINGS_NOT_USED: {message}",))


def _choose_code(description: UploadDescription, said: Said) -> None:
    """The shape's code from the file of codes, where the checkpoint has none and the caller gives none."""
    if said.trainer != "DeepSDF" or not said.documents.tensors or description.latent is not None:
        return
    if said.facts.count("latent_codes", "") or said.facts.shape("latent_codes"):
        return
    file, index = said.documents.tensors[0], description.latent_index or 0
    said.values["latent"], count = latent_code(file, index)
    said.used.setdefault(PurePosixPath(file.name).name, []).append(f"latent code {index} of {count}, counted from 0")


def _settings(said: Said) -> Settings:
    """The values, checked as a description is: what no field can have is no sound setting."""
    values: dict[str, Any] = {}
    for entry, value in said.values.items():
        part, _, name = entry.rpartition(".")
        (values.setdefault(part, {}) if part else values)[name] = value
    try:
        UploadDescription.from_dict(values)
    except FieldFormatError as error:
        raise malformed(
            f"{next(iter(said.used), 'the settings')}: {str(error).removeprefix('description.')}"
        ) from error
    why = tuple(f"{file}: {', '.join(keys)}"[:_MAX_WHY] for file, keys in said.used.items())
    return Settings(said.trainer, tuple(said.used), values, why, tuple(said.warnings))


def merged(said: dict[str, Any], by_settings: dict[str, Any]) -> dict[str, Any]:
    """A description of both; what the caller ``said`` goes before, and takes with it what would contradict it."""
    below = {name: value for name, value in by_settings.items() if name not in _PARTS}
    result = {**below, **{name: value for name, value in said.items() if value is not None}}
    if said.get("latent_index") is not None and said.get("latent") is None and "latent" in result:
        del result["latent_index"]  # the settings' code is the one of this index
    if "bounds" in by_settings and said.get("bounds") is None and said.get("world_scale") is not None:
        result["bounds"] = [[said["world_scale"] * value for value in corner] for corner in by_settings["bounds"]]
    for part in _PARTS:
        own = said.get(part) or {}
        theirs = dict(by_settings.get(part, {}))
        for one, other in (("top_resolution", "per_level_scale"), ("per_level_scale", "top_resolution")):
            if own.get(one) is not None:
                theirs.pop(other, None)
        result[part] = {**theirs, **own}
        if not result[part]:
            del result[part]
    return result


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{part}": inner for part, inner in value.items()}
        else:
            flat[name] = value
    return flat
