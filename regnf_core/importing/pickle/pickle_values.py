"""What the pickle reader makes of a file: plain values, descriptions of tensors, and inert stand-ins for all else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

DTYPES: dict[str, str] = {
    "FloatStorage": "float32",
    "DoubleStorage": "float64",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}
"""torch's storage classes and the element type of each. Others (complex, quantized) are read but never materialized."""


@dataclass(frozen=True, eq=False, slots=True)
class GlobalRef:
    """A name that occurs in the pickle. Nothing is imported; the name alone decides what the reader does with it."""

    module: str
    name: str

    @property
    def full_name(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(eq=False, slots=True)
class Placeholder:
    """Stands for an object the reader does not make. ``full_name`` is the global that would have made it."""

    full_name: str
    state: Any = None
    """What the object would have been given as its state, usually its attributes by name. Nothing was done with it."""


@dataclass(frozen=True, eq=False, slots=True)
class StorageRef:
    """A storage in the archive: entry ``data/<key>``. dtype is None for element types that are never materialized."""

    key: str
    dtype: str | None
    type_name: str
    count: int
    device: str


@dataclass(frozen=True, eq=False, slots=True)
class TensorRef:
    """A tensor that has not been read: a view of a storage. offset and strides count elements.

    ``plain`` is false where the tensor is more than a view (e.g. a conjugate or negative bit).
    """

    storage: StorageRef
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    plain: bool


@dataclass(frozen=True, eq=False, slots=True)
class NumpyType:
    """A numpy dtype by its code, e.g. "f8". Scalars of the plain number types are decoded, nothing else."""

    code: str
