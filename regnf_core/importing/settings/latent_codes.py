"""One shape's latent code out of a file of codes beside the settings, through the gate's own reader of pickles."""

from __future__ import annotations

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.container import read_archive
from regnf_core.importing.containers.legacy_container import read_legacy
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.pickle.pickle_values import TensorRef
from regnf_core.importing.run.opened import MAX_SETTINGS_BYTES, SettingsFile
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.labels import shown_path

_MAX_CODE = 512


def latent_code(file: SettingsFile, index: int) -> tuple[list[float], int]:
    """The code ``index`` of the file, and how many there are.

    Raises FieldFormatError: SETTINGS_MALFORMED, INVALID_DESCRIPTION for an index beyond them, and what the readers of
    torch.save's files raise.
    """
    stored, source = _stored(file)
    value = stored if isinstance(stored, TensorRef) else lookup(_mapping(file, stored), "weight")
    codes = source.array("latent_codes", value)
    if codes.ndim == 3 and codes.shape[1] == 1:
        codes = codes[:, 0]
    if codes.ndim != 2 or not 1 <= codes.shape[1] <= _MAX_CODE or not len(codes):
        raise _malformed(file, f"latent_codes of the shape {codes.shape}")
    if index >= len(codes):
        message = f"description.latent_index: {index}, but {file.name} has {len(codes)} codes, counted from 0"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
    return [float(number) for number in codes[index]], len(codes)


def _stored(file: SettingsFile) -> tuple[object, TensorSource]:
    kind = sniff_format(bytes(file.data[:HEAD_BYTES]))
    if kind == "torch-zip":
        archive = read_archive(file.data)
        values, source = read_pickle(archive.read("data.pkl")), TensorSource(archive, MAX_SETTINGS_BYTES)
    elif kind == "torch-legacy":
        values, legacy = read_legacy(file.data)
        source = TensorSource(legacy, MAX_SETTINGS_BYTES)
    else:
        raise _malformed(file, "no file of torch.save")
    return _mapping(file, values).get("latent_codes"), source


def _mapping(file: SettingsFile, value: object) -> dict[object, object]:
    if not isinstance(value, dict):
        raise _malformed(file, "no latent_codes")
    return value


def _malformed(file: SettingsFile, what: str) -> FieldFormatError:
    return FieldFormatError(f"{shown_path(file.name)}: {what}", reason="SETTINGS_MALFORMED")
