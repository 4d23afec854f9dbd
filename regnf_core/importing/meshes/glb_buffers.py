"""The numbers of a glTF document: accessors into its buffers, every extent checked first.

A buffer is the file's own binary chunk, text within the document, or a file that came with it. None is ever looked for.
"""

from __future__ import annotations

import base64
from typing import Any
from urllib.parse import unquote

import numpy as np

from regnf_core.importing.meshes.triangle_files import (
    MAX_TRIANGLES,
    Float64Array,
    Siblings,
    elsewhere,
    malformed,
    unsupported,
)

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MAX_ITEMS = 3 * MAX_TRIANGLES
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


class Accessors:
    """Reads accessors of ``document``. binary: the file's chunk, None in text form · siblings: files beside it."""

    def __init__(self, document: dict[str, Any], binary: memoryview | None, siblings: Siblings) -> None:
        self._accessors = document.get("accessors", [])
        self._views = document.get("bufferViews", [])
        self._buffers = document.get("buffers", [])
        self._binary = binary
        self._siblings = siblings
        self._read: dict[int, memoryview] = {}

    def array(self, number: object, width: int) -> Float64Array:
        """The items (N, width) of accessor ``number``.

        Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED or MESH_EXTERNAL_REFERENCE.
        """
        accessor = self._accessors[_whole(number)]
        component = _COMPONENTS.get(accessor["componentType"])
        if component is None or _WIDTHS.get(accessor["type"]) != width:
            raise malformed("a glTF accessor of an unexpected type")
        count = _whole(accessor["count"])
        if count > _MAX_ITEMS:
            raise malformed(f"a glTF accessor of {count} items")
        items = np.zeros((count, width))
        if "bufferView" in accessor:
            items = self._items(accessor, component, count, width)
        if "sparse" in accessor:
            said = accessor["sparse"]
            changed, type_ = _whole(said["count"]), _COMPONENTS.get(said["indices"]["componentType"])
            if type_ is None or type_[1] != "u" or changed > count:
                raise malformed("a glTF sparse accessor of more items than there are")
            at = self._items(said["indices"], type_, changed, 1).reshape(-1).astype(np.int64)
            if len(at) and at.max() >= count:
                raise malformed("a glTF sparse accessor of an item that does not exist")
            items[at] = self._items(said["values"], component, changed, width)
        return _scaled(items, component, bool(accessor.get("normalized", False)))

    def is_stored(self, number: object) -> bool:
        """Whether accessor ``number`` has numbers of its own."""
        accessor = self._accessors[_whole(number)]
        return "bufferView" in accessor or "sparse" in accessor

    def _items(self, said: dict[str, Any], component: str, count: int, width: int) -> Float64Array:
        """(count, width) numbers of a buffer view, from a byte offset on."""
        view, item = self._views[_whole(said["bufferView"])], np.dtype(component).itemsize * width
        data = self._view(view)
        stride, start = _whole(view.get("byteStride", item)), _whole(said.get("byteOffset", 0))
        if stride < item or start + stride * max(count - 1, 0) + item * min(count, 1) > len(data):
            raise malformed("a glTF accessor reaches beyond its buffer view")
        items = np.ndarray((count, width), component, data, start, (stride, np.dtype(component).itemsize))
        return items.astype(np.float64)

    def _view(self, view: dict[str, Any]) -> memoryview:
        if any(name in view.get("extensions", {}) for name in COMPRESSED):
            raise unsupported("the glTF file's buffers are compressed: export it without mesh compression")
        data = self._buffer(_whole(view["buffer"]))
        start, size = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        if start + size > len(data):
            raise malformed("a glTF buffer view reaches beyond its buffer")
        return data[start : start + size]

    def _buffer(self, number: int) -> memoryview:
        """The bytes of a buffer, no more than it claims."""
        if number not in self._read:
            buffer = self._buffers[number]
            claimed = _whole(buffer["byteLength"])
            if "uri" in buffer:
                data = self._elsewhere(buffer["uri"], claimed)
            elif number == 0 and self._binary is not None:
                data = self._binary
            else:
                raise malformed("a glTF buffer without data")
            self._read[number] = data[: min(len(data), claimed)]
        return self._read[number]

    def _elsewhere(self, uri: object, claimed: int) -> memoryview:
        """The bytes that a buffer's ``uri`` holds, or that came under this name."""
        if not isinstance(uri, str):
            raise malformed("a glTF buffer's uri is not text")
        if uri.startswith("data:"):
            head, comma, text = uri.partition(",")
            if not comma or not head.endswith(";base64") or len(text) * 3 // 4 > claimed + 3:
                raise malformed("a glTF buffer's data is not base64 of the length that it claims")
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except ValueError as error:
                raise malformed("a glTF buffer's data is not base64") from error
        name = unquote(uri).removeprefix("./")
        if name not in self._siblings:
            missing = "the glTF file keeps its geometry in another file or address: "
            raise elsewhere(missing + "give both in one archive, or export it as one .glb")
        return self._siblings[name]


def _scaled(items: Float64Array, component: str, normalized: bool) -> Float64Array:
    if not normalized or component == "<f4":
        return items
    top = float(np.iinfo(np.dtype(component)).max)
    return np.maximum(items / top, -1.0)


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 48:
        raise malformed("a glTF count, offset or index that is not a number")
    return value
