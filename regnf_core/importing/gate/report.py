"""What an import may use, and what it reports. Torch- and numpy-free."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from regnf_core.errors import FieldFormatError
from regnf_core.processes import memory_of_the_machine
from regnf_core.schema.similarity import moved_box, product, shift_rows

if TYPE_CHECKING:
    from regnf_core.importing.families.converted import ConvertedField
    from regnf_core.importing.upload_description import UploadDescription

MIB = 1024 * 1024


@dataclass(frozen=True)
class ImportLimits:
    """Bounds of one import. Beyond any of them it ends with a reason, and nothing of it stays."""

    wall_s: float | None = None
    """Seconds from start to end, by a fair clock; then IMPORT_TIMEOUT. None: as long as it takes, which is right for a
    person's own file on the person's own machine."""
    work_s: float = 60.0
    """Seconds of one core for the field's evaluation. What is estimated to take longer is tried at fewer points; with
    ``wall_s`` it is refused with IMPORT_TOO_COSTLY, at once."""
    memory_bytes: int = 8192 * MIB
    """Address space, the mapped upload (and about 1 GiB of libraries) included; then IMPORT_OUT_OF_MEMORY."""
    tensor_bytes: int = 4096 * MIB
    """All tensors of the field together, as float32; then TENSOR_TOO_LARGE."""
    file_bytes: int = 4096 * MIB
    """Largest file the import may write; then IMPORT_OUTPUT_TOO_LARGE."""

    @classmethod
    def of_the_machine(cls) -> ImportLimits:
        """Those of a person's own file on the person's own machine: no time, and all of its memory, 8 GiB at least;
        tensors and files of half of it."""
        memory = max(cls.memory_bytes, memory_of_the_machine())
        return cls(memory_bytes=memory, tensor_bytes=memory // 2, file_bytes=memory // 2)

    @property
    def longest_s(self) -> float:
        """``wall_s``; without it, infinity."""
        return math.inf if self.wall_s is None else self.wall_s

    @property
    def refused_beyond_s(self) -> float:
        """``work_s``; without ``wall_s``, infinity."""
        return math.inf if self.wall_s is None else self.work_s

    def no_memory(self) -> str:
        """What is said beyond the limit on memory."""
        return f"the import needs more than the {self.memory_bytes >> 20} MiB of memory that are allowed"


_WORDS_OF_THE_FILE = """
    AMBIGUOUS_RUN ARCHIVE_BYTE_ORDER ARCHIVE_COMPRESSED_ENTRY ARCHIVE_CRC_MISMATCH ARCHIVE_DEFLATE_MALFORMED
    ARCHIVE_DUPLICATE_ENTRY ARCHIVE_ENCRYPTED ARCHIVE_ENTRY_NAME ARCHIVE_ENTRY_OUT_OF_BOUNDS
    ARCHIVE_HEADER_MISMATCH ARCHIVE_HIDDEN_DATA ARCHIVE_LINK ARCHIVE_MALFORMED ARCHIVE_MULTI_DISK ARCHIVE_NESTED
    ARCHIVE_NO_PICKLE ARCHIVE_OVERLAP ARCHIVE_PREFIXED_DATA ARCHIVE_SPECIAL_FILE ARCHIVE_TOO_LARGE
    ARCHIVE_TOO_MANY_ENTRIES ARCHIVE_TORCHSCRIPT ARCHIVE_TRAILING_DATA BOUNDS_INVALID CAMERAS_INTRINSICS_MISSING
    CAMERAS_MALFORMED CAMERAS_NOT_RECOGNIZED CAMERAS_NOT_SUPPORTED CAMERAS_OF_ANOTHER_FRAME FAMILY_NOT_SUPPORTED
    FIELD_IMPLAUSIBLE FIELD_INDEX_INVALID FIELD_KIND_UNKNOWN FIELD_NOT_A_FUNCTION FIELD_NOT_FINITE
    FIELD_NOT_RECOGNIZED FIELD_SHAPES_MISMATCH FILE_EMPTY FILE_TRUNCATED FORMAT_NOT_RECOGNIZED
    FORMAT_NOT_SUPPORTED HASH_GRID_NOT_RECOGNIZED INVALID_DESCRIPTION LATENT_MISSING LAYOUT_AMBIGUOUS
    LEGACY_MALFORMED LEGACY_TORCH_FILE MESH_EXTERNAL_REFERENCE MESH_INVALID MESH_TOO_LARGE NO_ZERO_LEVEL
    NPY_MALFORMED NPY_OBJECT_ARRAY ONNX_EXTERNAL_DATA ONNX_GRAPH_INVALID ONNX_MALFORMED ONNX_NOT_SUPPORTED
    PICKLE_INTEGER_TOO_LARGE PICKLE_MALFORMED PICKLE_OPCODE_NOT_ALLOWED PICKLE_PROTOCOL PICKLE_STRING_TOO_LARGE
    PICKLE_TOO_COMPLEX PICKLE_TOO_DEEP PICKLE_TOO_LARGE PICKLE_TRAILING_DATA POINT_CLOUD_TOO_SMALL
    RAW_PICKLE RUN_TOO_LARGE RUN_WITHOUT_CHECKPOINT SAFETENSORS_DUPLICATE_KEY SAFETENSORS_HEADER_MALFORMED
    SAFETENSORS_HEADER_TOO_LARGE SAFETENSORS_LAYOUT SAFETENSORS_TOO_MANY_TENSORS SAFE_FORMAT_INVALID
    SAFE_FORMAT_VERSION SETTINGS_CONTRADICT_TENSORS SETTINGS_MALFORMED SETTINGS_NOT_RECOGNIZED
    SETTINGS_TOO_LARGE SETTINGS_UNSAFE SQLITE_MALFORMED SQLITE_NOT_PLAIN TENSOR_DEVICE TENSOR_DTYPE
    TENSOR_EXPECTED TENSOR_MISSING TENSOR_NOT_DENSE TENSOR_NOT_FINITE TENSOR_SHAPE TENSOR_STORAGE_MISMATCH
    TENSOR_STORAGE_MISSING TENSOR_TOO_LARGE TRUNCATION_UNKNOWN UNSAFE_GLOBAL_IN_WEIGHTS
"""
OF_THE_FILE = frozenset(_WORDS_OF_THE_FILE.split())
"""Reasons that follow from the bytes and what was said of them: the same upload ends so again, whenever it is tried."""


@dataclass(frozen=True)
class ImportReport:
    """An import that succeeded. Lengths are in the field's own units, its own frame."""

    family: str
    """The format of the file: which trainer or program wrote it."""
    kind: str
    """The kind of the stored field: which function it is; see docs/safe-format.md."""
    why: tuple[str, ...]
    """The evidence for the family, one short sentence each."""
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Lowest and highest corner of the region where the field has meaning."""
    surface_bounds: tuple[tuple[float, float, float], tuple[float, float, float]]
    """The same of the surface: of some thousand points on it, so a thin end may reach a little further."""
    parameters: int
    plausibility: dict[str, float]
    """What was measured of the evaluated field; see ``plausibility``."""
    warnings: tuple[str, ...]
    """Each begins with a stable UPPER_SNAKE word and a colon."""
    assumed: tuple[str, ...]
    """What the file does not state; see :mod:`regnf_core.importing.assumptions`."""
    label: str | None
    settings: dict[str, Any] | None
    """The trainer's settings that counted: ``trainer``, ``files`` (their names) and ``used`` (entries of a description,
    such as hash.levels, and their values). None where there were none."""
    field_bytes: int
    seconds: float
    cpu_seconds: float
    peak_memory_bytes: int
    isolation: dict[str, bool]
    """Which of the child's confinements the kernel granted."""

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return dataclasses.asdict(self)


# The dataset's frame: a field that was converted in its own is placed by the transform its trainer applied, undone.


def placed(converted: ConvertedField, description: UploadDescription) -> ConvertedField:
    """``converted`` in the frame that the description asks for, and in ``why`` whether the dataset's is known.

    Raises FieldFormatError (INVALID_DESCRIPTION) where the dataset's frame is requested and not known.
    """
    rows = description.dataset_transform
    if rows is None:
        if description.frame == "dataset":
            message = (
                "description.frame: the dataset's frame is not known. Put the file that has it into the run's folder:"
                " dataparser_transforms.json (nerfstudio) or the dataset's meta_data.json (sdfstudio), or give"
                " dataset_transform"
            )
            raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
        return converted
    a, b, c = rows[0][:3]
    unit = (a * a + b * b + c * c) ** 0.5
    if description.frame != "dataset":
        why = (
            f"the dataset's frame is known, and one unit of the field is {unit:g} of it; to use it, give the "
            f"import option frame: dataset"
        )
        return replace(converted, why=(*converted.why, why))
    # world_scale is the length of the dataset's unit then: it scales the shift, as it has scaled the field.
    scale = description.world_scale or 1.0
    transform = [[*row[:3], scale * row[3]] for row in rows[:3]] + [rows[3]]
    bounds = converted.description["bounds"]
    before = converted.description.get("placement") or {"transform": shift_rows((0.0, 0.0, 0.0)), "bounds": bounds}
    placement = {"transform": product(transform, before["transform"]), "bounds": before["bounds"]}
    changed = converted.description | {"bounds": moved_box(transform, bounds), "placement": placement}
    why = f"in the dataset's frame: one unit of the network's coordinates is {unit:g} of the dataset's"
    return replace(converted, description=changed, why=(*converted.why, why))
