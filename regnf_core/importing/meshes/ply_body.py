"""The rows of a PLY file, as text or in binary: single values at once, rows with lists one by one if they must be."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Int64Array, fan, fans, malformed, require_room
from regnf_core.importing.meshes.number_text import numbers_of
from regnf_core.importing.meshes.ply_header import ByteOrder, Element

_USUAL_CORNERS = (3, 4)


class Body(ABC):
    """Hands out one element after the other, in the header's order."""

    flat_faces: int = 0
    """Faces of fewer than three corners, which were left out."""

    @abstractmethod
    def scalars(self, element: Element) -> dict[str, Float64Array]:
        """The columns (count,) of an element's single values; lists beside them are passed over."""

    @abstractmethod
    def _regular(self, element: Element, corners: int) -> Any | None:
        """(count, columns) rows by name if every list has this length; None, nothing taken, if not."""

    @abstractmethod
    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        """The rows one by one; lists as arrays."""

    def _scalars_beside_lists(self, element: Element) -> dict[str, Float64Array]:
        names = [p.name for p in element.properties if p.count_type is None]
        table = [[float(row[name][0]) for name in names] for row in self._rows(element)]
        columns = np.array(table, dtype=np.float64).reshape(-1, len(names)).T
        return dict(zip(names, columns, strict=True))

    def skip(self, element: Element) -> None:
        """Pass over an element."""
        if all(p.count_type is None for p in element.properties):
            self.scalars(element)
        else:
            for _ in self._rows(element):
                pass

    def lists(self, element: Element, name: str) -> Iterator[Int64Array]:
        """The list called ``name`` of every row, of any length."""
        for row in self._rows(element):
            yield np.asarray(row[name], dtype=np.int64)

    def triangles(self, element: Element, name: str) -> Int64Array:
        """(F, 3) indices from the lists called ``name``, longer ones as fans."""
        for corners in _USUAL_CORNERS:
            rows = self._regular(element, corners)
            if rows is not None:
                require_room(0, (corners - 2) * element.count)
                return fans(rows[name])
        found: list[Int64Array] = []
        triangles = 0
        for row in self._rows(element):
            polygon = np.asarray(row[name], dtype=np.int64)
            self.flat_faces += len(polygon) < 3
            triangles += max(len(polygon) - 2, 0)
            require_room(0, triangles)
            found.append(fan(polygon))
        return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


class BinaryBody(Body):
    """Rows of packed numbers."""

    def __init__(self, data: memoryview, byte_order: ByteOrder) -> None:
        self._data = data
        self._order = byte_order

    def scalars(self, element: Element) -> dict[str, Float64Array]:
        if any(p.count_type is not None for p in element.properties):
            return self._scalars_beside_lists(element)
        rows = self._table(element, 0)
        if rows is None:
            raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
        self._data = self._data[rows.nbytes :]
        return {p.name: rows[p.name].astype(np.float64) for p in element.properties}

    def _regular(self, element: Element, corners: int) -> Any | None:
        lists = [p.name for p in element.properties if p.count_type is not None]
        rows = self._table(element, corners)
        if len(lists) != 1 or rows is None or not (rows[f"{lists[0]} length"] == corners).all():
            return None
        self._data = self._data[rows.nbytes :]
        return rows

    def _table(self, element: Element, corners: int) -> Any | None:
        """The rows if every list has ``corners`` items; None if there are not so many bytes."""
        fields: list[tuple[Any, ...]] = []
        for p in element.properties:
            if p.count_type is None:
                fields.append((p.name, self._order + p.type))
            else:
                fields.append((f"{p.name} length", self._order + p.count_type))
                fields.append((p.name, self._order + p.type, (corners,)))
        row = np.dtype(fields)
        if element.count * row.itemsize > len(self._data):
            return None
        return np.frombuffer(self._data, dtype=row, count=element.count)

    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        data, at = self._data, 0
        types = [(p, np.dtype(self._order + p.type), p.count_type) for p in element.properties]
        for _ in range(element.count):
            row: dict[str, Any] = {}
            for p, type_, count_type in types:
                count = 1
                if count_type is not None:
                    width = np.dtype(count_type).itemsize
                    order, signed = ("little" if self._order == "<" else "big"), count_type.startswith("i")
                    count = int.from_bytes(data[at : at + width], order, signed=signed)  # type: ignore[arg-type]
                    at += width
                size = count * type_.itemsize
                if count < 0 or at + size > len(data):
                    raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
                row[p.name] = np.frombuffer(data[at : at + size], dtype=type_)
                at += size
            yield row
        self._data = data[at:]


class TextBody(Body):
    """Rows of numbers between spaces."""

    def __init__(self, data: memoryview) -> None:
        self._numbers = numbers_of(bytes(data), "PLY")

    def scalars(self, element: Element) -> dict[str, Float64Array]:
        if any(p.count_type is not None for p in element.properties):
            return self._scalars_beside_lists(element)
        width = len(element.properties)
        rows = self._take(element, element.count * width).reshape(element.count, width)
        return {p.name: rows[:, i] for i, p in enumerate(element.properties)}

    def _regular(self, element: Element, corners: int) -> Any | None:
        if len(element.properties) != 1 or element.count * (corners + 1) > len(self._numbers):
            return None
        rows = self._numbers[: element.count * (corners + 1)].reshape(element.count, corners + 1)
        if not (rows[:, 0] == corners).all():
            return None
        self._take(element, rows.size)
        return {element.properties[0].name: _whole(rows[:, 1:])}

    def _rows(self, element: Element) -> Iterator[dict[str, Any]]:
        numbers, at = self._numbers, 0
        for _ in range(element.count):
            row: dict[str, Any] = {}
            for p in element.properties:
                count = 1
                if p.count_type is not None:
                    claimed = numbers[at] if at < len(numbers) else -1.0
                    count = int(claimed) if 0 <= claimed <= len(numbers) else -1
                    at += 1
                if count < 0 or at + count > len(numbers):
                    raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
                values = numbers[at : at + count]
                row[p.name] = _whole(values) if p.count_type is not None else values
                at += count
            yield row
        self._numbers = numbers[at:]

    def _take(self, element: Element, count: int) -> Float64Array:
        if count > len(self._numbers):
            raise malformed(f"the PLY file ends within its {element.name[:40]} rows")
        taken, self._numbers = self._numbers[:count], self._numbers[count:]
        return taken


def _whole(values: Float64Array) -> Int64Array:
    """Numbers as indices. Raises FieldFormatError (MESH_INVALID) for what is none."""
    if not (np.isfinite(values) & (np.abs(values) < 2.0**53)).all():
        raise malformed("a PLY index that is not a number")
    return values.astype(np.int64)
