"""Settings files by name: each read by the reader of its format when a trainer's module asks for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.npz import ArraySource
from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.settings.hocon_reader import read_hocon
from regnf_core.importing.settings.json_reader import read_json
from regnf_core.importing.settings.keys import Keys
from regnf_core.importing.settings.plain import looks_like_json
from regnf_core.importing.settings.yaml_reader import read_yaml

_YAML, _HOCON, _JSON, _ARRAYS, _TENSORS = (".yml", ".yaml"), (".conf", ".hocon"), (".json",), (".npz",), (".pth", ".pt")
_ARRAY_BYTES = 1 << 20


@dataclass(frozen=True)
class Documents:
    """All settings files of one run."""

    keys: tuple[Keys, ...]
    """The texts, parsed, in the order in which they were found."""
    arrays: tuple[tuple[str, ArraySource], ...]
    tensors: tuple[SettingsFile, ...]
    """Files of torch.save beside the settings: latent codes."""

    def named(self, name: str) -> Keys | None:
        """The text of this name, if it is there."""
        return next((keys for keys in self.keys if keys.file == name), None)


def read_documents(files: tuple[SettingsFile, ...]) -> Documents:
    """Raises FieldFormatError: the SETTINGS_* reasons, and those of a malformed .npz file."""
    keys, arrays, tensors = [], [], []
    for file in files:
        name = PurePosixPath(file.name).name
        end = PurePosixPath(name).suffix.lower()
        if end in _ARRAYS:
            arrays.append((name, ArraySource(file.data, _ARRAY_BYTES)))
        elif end in _TENSORS:
            tensors.append(file)
        else:
            keys.append(Keys(name, _tree(name, end, file.data)))
    return Documents(tuple(keys), tuple(arrays), tuple(tensors))


def _tree(name: str, end: str, data: memoryview) -> Any:
    """By the name's end; of a name without a known one, by the first bytes."""
    if end in _HOCON:
        return read_hocon(name, data)
    if end in _JSON or (end not in _YAML and looks_like_json(data)):
        return read_json(name, data)
    return read_yaml(name, data)


def mappings(documents: Documents) -> Iterator[Keys]:
    """The texts that hold keys at all."""
    for keys in documents.keys:
        if isinstance(keys.find(""), dict):
            yield keys


def optional_arrays(documents: Documents, array: str) -> tuple[str, list[list[float]]] | None:
    """The small matrix ``array`` of the first .npz file that has it, and that file's name."""
    for name, source in documents.arrays:
        if array in source:
            values = source.numbers(array)
            if values.ndim != 2:
                raise FieldFormatError(f"{name}: {array} is no matrix", reason="SETTINGS_MALFORMED")
            return name, values.tolist()
    return None
