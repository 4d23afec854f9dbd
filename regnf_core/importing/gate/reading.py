"""From the upload's bytes to a field: the archive opened, the settings translated, the format's own reader called."""

from __future__ import annotations

import mmap
import os
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.sniff import HEAD_BYTES, MESH_FORMATS, explain_refusal, sniff_format, splat_format
from regnf_core.importing.gate.report import ImportLimits

if TYPE_CHECKING:
    from collections.abc import Callable

    from regnf_core.importing.families.converted import ConvertedField
    from regnf_core.importing.families.radiance_field import Radiance
    from regnf_core.importing.observing.trajectory import Trajectory
    from regnf_core.importing.run.opened import OpenedUpload, SettingsFile
    from regnf_core.importing.settings.facts import Facts
    from regnf_core.importing.settings.translate import Settings
    from regnf_core.importing.tensor_source import TensorSource
    from regnf_core.importing.upload_description import UploadDescription

    Describe = Callable[[Facts], UploadDescription]
    """The description, the settings' part of it included, for a checkpoint of which some facts are known."""

Named = tuple[str, Path]
"""What a file is called, and where it can be read."""


@dataclass(frozen=True, eq=False)
class ReadUpload:
    """What was read. description: of caller and settings · settings: what the report says about the latter · cameras:
    those that came, or those beside the checkpoint, unless there are none of either."""

    field: ConvertedField
    description: UploadDescription
    settings: dict[str, Any] | None
    cameras: Trajectory | None


@dataclass(frozen=True)
class Companions:
    """Files that came with an upload: the trainer's settings, and where the cameras stood."""

    settings: Named | None = None
    cameras: Named | None = None


def read_upload(
    upload: Path, folder: Path, description: dict[str, Any] | None, limits: ImportLimits, beside: Companions
) -> ReadUpload:
    """The field in ``upload``, and what came with it.

    Large parts of archives are unpacked to ``folder``. Raises FieldFormatError with the reason of the refusing stage.
    """
    from regnf_core.importing.run.opened import open_settings, open_upload
    from regnf_core.importing.run.tar_run import new_file
    from regnf_core.importing.upload_description import UploadDescription

    said = UploadDescription.from_dict(description)
    opened = open_upload(_mapped(upload), folder, limits.file_bytes)
    files, settings = opened.settings, beside.settings
    trajectory = None if beside.cameras is None else _given_cameras(beside.cameras, folder, limits, said)
    if settings is not None:
        files = open_settings(_mapped(settings[1]), settings[0], folder, limits.file_bytes)
    required = settings is not None and len(files) == 1 and files[0].name == settings[0]
    translated = _Translation(files, said, description or {}, required)
    path = upload if opened.name is None else new_file(folder)
    if (kind := splat_format(opened.data)) is not None:
        return _read_splats(kind, opened, said, trajectory, limits)
    trained = _Trained(trajectory, files)
    converted = _convert(opened, path, translated, limits, trained)
    converted = translated.noted(converted, opened.name)
    if trained.description is not None:
        return ReadUpload(converted, trained.description, translated.settings.report(), None)
    if trajectory is None:
        trajectory, converted = _found_cameras(files, translated.description, converted)
    return ReadUpload(converted, translated.description, translated.settings.report(), trajectory)


def _given_cameras(named: Named, folder: Path, limits: ImportLimits, said: UploadDescription) -> Trajectory:
    """The cameras that came with the upload. Raises FieldFormatError: the CAMERAS_* reasons and those of archives."""
    from regnf_core.importing.observing.reading import read_trajectory
    from regnf_core.importing.observing.trajectory import MOST_CAMERAS
    from regnf_core.importing.run.opened import open_settings

    files = open_settings(_mapped(named[1]), named[0], folder, limits.file_bytes, MOST_CAMERAS)
    return read_trajectory(files, said.cameras)


def _found_cameras(
    files: tuple[SettingsFile, ...], description: UploadDescription, converted: ConvertedField
) -> tuple[Trajectory | None, ConvertedField]:
    """The cameras in a run's settings, where the field's frame is known against theirs, or a warning."""
    from regnf_core.importing.observing.reading import beside_checkpoint, read_trajectory

    found = beside_checkpoint(files)
    if not found or description.dataset_transform is None:
        return None, converted
    try:
        return read_trajectory(found, description.cameras), converted
    except FieldFormatError as error:
        if error.reason in ("CAMERAS_NOT_RECOGNIZED", "CAMERAS_INTRINSICS_MISSING"):
            return None, converted  # the file is there for other objects
        return None, with_unused_cameras(converted, str(error))


def with_unused_cameras(converted: ConvertedField, why: str) -> ConvertedField:
    """The field with a warning: cameras that cannot be used, or need not, are no reason to refuse it."""
    return replace(converted, warnings=(*converted.warnings, f"CAMERAS_NOT_USED: {why}"))


def _read_splats(
    kind: str, opened: OpenedUpload, said: UploadDescription, given: Trajectory | None, limits: ImportLimits
) -> ReadUpload:
    """By the cameras that came with them, or those that the trainer of 3DGS keeps beside them, in the same frame."""
    from regnf_core.importing.assumptions import PLACES
    from regnf_core.importing.families.gaussian_splats import ASSUMPTIONS, convert_splats, read_splats
    from regnf_core.importing.observing.reading import read_trajectory
    from regnf_core.importing.run.opened import TRAINED_CAMERAS

    beside = [file for file in opened.settings if PurePosixPath(file.name).name == TRAINED_CAMERAS]
    cameras = given or (read_trajectory(beside, said.cameras) if beside else None)
    origin = f"a {kind} file" if opened.name is None else opened.name[-200:]
    splats = read_splats(kind, opened.data, opened.siblings, said.node)
    converted = convert_splats(splats, origin, said, cameras, limits.tensor_bytes, ASSUMPTIONS.get(kind, PLACES))
    return ReadUpload(converted, said, None, None)


class _Translation:
    """The settings' translation, made once the checkpoint's facts are known, and what became of it."""

    def __init__(
        self, files: tuple[SettingsFile, ...], said: UploadDescription, values: dict[str, Any], required: bool
    ) -> None:
        from regnf_core.importing.settings.translate import Settings

        self._files, self._said, self._values, self._required = files, said, values, required
        self.settings: Settings = Settings()
        self.description = said

    def __call__(self, facts: Facts) -> UploadDescription:
        """The description of both. Raises what ``translate_settings`` and UploadDescription raise."""
        from regnf_core.importing.settings.translate import merged, translate_settings
        from regnf_core.importing.upload_description import UploadDescription

        if not self._files:
            return self._said
        self.settings = translate_settings(self._files, facts, self._said, self._required)
        self.description = UploadDescription.from_dict(merged(self._values, self.settings.values))
        return self.description

    def noted(self, converted: ConvertedField, name: str | None) -> ConvertedField:
        """The field, with what the settings decided among the evidence."""
        where = () if name is None else (f"the run's checkpoint is {name[-200:]}",)
        return replace(
            converted,
            why=(*where, *converted.why, *self.settings.why),
            warnings=(*converted.warnings, *self.settings.warnings),
        )


class _Trained:
    """Radiance fields are seen by the cameras of their training: those given, or those in the run or the file."""

    def __init__(self, given: Trajectory | None, files: tuple[SettingsFile, ...]) -> None:
        self._given, self._files = given, files
        self.description: UploadDescription | None = None
        """Of such a field: the frame is the dataset's, whose cameras they are, if it is known and no other is said."""

    def surface(
        self, radiance: Radiance, said: UploadDescription, limits: ImportLimits, own: Trajectory | None = None
    ) -> ConvertedField:
        """The field of what the cameras see. own: in the file, in its frame. Raises FieldFormatError."""
        from regnf_core.importing.families.radiance_field import surface_of
        from regnf_core.importing.observing.reading import beside_checkpoint, read_trajectory

        beside = () if own is not None else beside_checkpoint(self._files)
        cameras = self._given or (read_trajectory(beside, said.cameras) if beside else None)
        known = cameras is not None and said.dataset_transform is not None and said.frame is None
        self.description = replace(said, frame="dataset") if known else said
        if cameras is None and own is not None:
            cameras, said = own, replace(said, dataset_transform=None)
        elif cameras is not None:
            radiance = replace(radiance, assumes=(*radiance.assumes, *cameras.assumes))
        return surface_of(radiance, cameras, said, limits.tensor_bytes, limits.refused_beyond_s)


def _convert(
    opened: OpenedUpload, path: Path, describe: Describe, limits: ImportLimits, trained: _Trained
) -> ConvertedField:
    """By the format's own reader. path: the upload itself, or where a file out of an archive may be written."""
    from regnf_core.importing.families.safe_field import convert_safe_field
    from regnf_core.importing.settings.facts import Facts

    data, tensor_bytes = opened.data, limits.tensor_bytes
    head = bytes(data[:HEAD_BYTES])
    kind = sniff_format(head)
    if kind in ("torch-zip", "torch-legacy"):
        return _convert_torch(kind, opened, limits, describe, trained)
    if kind == "instant-ngp":
        return _convert_snapshot(opened.data, limits, describe, trained)
    if kind == "npz":
        from regnf_core.importing.containers.npz import ArraySource
        from regnf_core.importing.families.arrays import convert_arrays  # loads scipy

        return convert_arrays(ArraySource(data, tensor_bytes, opened.members), describe(Facts()))
    if kind == "safetensors":
        if opened.name is not None:
            path.write_bytes(data)
        return convert_safe_field(path, data, tensor_bytes, describe(Facts()))
    if kind == "onnx":
        from regnf_core.importing.families.onnx import convert_onnx

        return convert_onnx(data, tensor_bytes, describe(Facts()))
    if kind == "sqlite":
        from regnf_core.importing.containers.sqlite_source import TableSource
        from regnf_core.importing.families.nvblox import convert_database

        return convert_database(TableSource(data), tensor_bytes, describe(Facts()))
    if kind in MESH_FORMATS:
        from regnf_core.importing.families.mesh import convert_mesh

        if kind == "e57" and opened.name is not None:
            path.write_bytes(data)
        return convert_mesh(kind, data, describe(Facts()), limits.refused_beyond_s, opened.siblings, path)
    reason, detail = explain_refusal(head, opened.name or "")
    raise FieldFormatError(detail, reason=reason)


def _convert_snapshot(data: memoryview, limits: ImportLimits, describe: Describe, trained: _Trained) -> ConvertedField:
    from regnf_core.importing.settings.facts import Facts
    from regnf_core.importing.snapshots.instant_ngp import cameras_of, read_radiance, snapshot_of, to_dataset
    from regnf_core.importing.snapshots.msgpack import read_msgpack, unpacked

    snapshot, said = snapshot_of(read_msgpack(unpacked(data, limits.file_bytes))), describe(Facts())
    radiance = read_radiance(snapshot, limits.tensor_bytes, said)
    said = replace(said, dataset_transform=said.dataset_transform or to_dataset(snapshot))
    return trained.surface(radiance, said, limits, cameras_of(snapshot))


def _convert_torch(
    kind: str, opened: OpenedUpload, limits: ImportLimits, describe: Describe, trained: _Trained
) -> ConvertedField:
    from regnf_core.importing.containers.legacy_container import read_archive, read_legacy
    from regnf_core.importing.families import convert_checkpoint, nerfacto
    from regnf_core.importing.pickle.pickle_reader import read_pickle
    from regnf_core.importing.settings.facts import facts_of
    from regnf_core.importing.tensor_source import TensorSource

    source: TensorSource
    if kind == "torch-zip":
        archive = read_archive(opened.data, members=opened.members)
        values, source = read_pickle(archive.read("data.pkl")), TensorSource(archive, limits.tensor_bytes)
    else:
        values, legacy = read_legacy(opened.data)
        source = TensorSource(legacy, limits.tensor_bytes)
    said = describe(facts_of(values, source))
    radiance = nerfacto.read_radiance(values, source, said)
    if radiance is not None:
        return trained.surface(radiance, said, limits)
    return convert_checkpoint(values, source, said)


def _mapped(path: Path) -> memoryview:
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return memoryview(b"")
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
