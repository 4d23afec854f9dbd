"""The header of a PLY file: which elements follow, and what each row of them holds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from regnf_core.errors import FieldFormatError
from regnf_core.importing.meshes.geometry import malformed

ByteOrder = Literal["<", ">"]

_MAX_HEADER = 1 << 16
_MAX_PARTS = 64
_CODES = {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16"} | {
    "i4": "int int32",
    "u4": "uint uint32",
    "f4": "float float32",
    "f8": "double float64",
}
_TYPES = {name: code for code, names in _CODES.items() for name in names.split()}
_FORMATS: dict[str, ByteOrder | None] = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"(?:^|\n)end_header[ \t]*\r?\n")

_SPLAT = frozenset({"f_dc_0", "opacity", "scale_0", "rot_0"})
"""Of the points that are Gaussians."""


@dataclass(frozen=True)
class Property:
    """One value of a row, or a list of them: numpy type codes without byte order."""

    name: str
    type: str
    count_type: str | None = None
    """The type of the length that stands before a list; None: a single value."""


@dataclass(frozen=True)
class Element:
    """``count`` rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]


@dataclass(frozen=True)
class Header:
    """The header takes ``size`` bytes; ``byte_order`` None means text."""

    byte_order: ByteOrder | None
    elements: tuple[Element, ...]
    size: int


def read_ply_header(data: memoryview) -> Header:
    """The header. Raises FieldFormatError: MESH_INVALID, or FAMILY_NOT_SUPPORTED for Gaussian splats."""
    head = bytes(data[:_MAX_HEADER])
    end = _END.search(head)
    if end is None:
        raise malformed("no end of the PLY header in sight")
    lines = head[: end.start()].decode("latin-1").splitlines()
    words = [line.split() for line in lines[1:] if line.strip()]
    words = [line for line in words if line[0] not in ("comment", "obj_info")]
    if not words or words[0][0] != "format" or len(words[0]) != 3 or words[0][1] not in _FORMATS:
        raise malformed("the PLY header names no known format")
    return Header(_FORMATS[words[0][1]], _elements(words[1:]), end.end())


def _elements(lines: list[list[str]]) -> tuple[Element, ...]:
    found: list[tuple[str, int, list[Property]]] = []
    for line in lines:
        match line:
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                found.append((name, int(count), []))
            case ["property", "list", count_type, type_, name] if found and {count_type, type_} <= _TYPES.keys():
                found[-1][2].append(Property(name, _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name] if found and type_ in _TYPES:
                found[-1][2].append(Property(name, _TYPES[type_]))
            case _:
                raise malformed("the PLY header has a line that makes no sense")
    elements = tuple(Element(name, count, tuple(properties)) for name, count, properties in found)
    names = [element.name for element in elements]
    if len(elements) > _MAX_PARTS or len(set(names)) != len(names):
        raise malformed("the PLY header names an element twice, or too many of them")
    for element in elements:
        properties = [p.name for p in element.properties]
        if set(properties) >= _SPLAT:
            message = "Gaussian splats, which have no surface; extract a mesh from them, and give that"
            raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
        if not properties or len(properties) > _MAX_PARTS or len(set(properties)) != len(properties):
            raise malformed(f"the PLY element {element.name[:40]} has no properties, too many, or one twice")
        if any(p.count_type is not None and p.count_type.startswith("f") for p in element.properties):
            raise malformed("a PLY list whose length is not an integer")
    return elements
