"""The numbers of a glTF document: accessors into the file's own binary chunk, every extent checked first."""

from __future__ import annotations

from typing import Any

import numpy as np

from regnf_core.importing.meshes.geometry import MAX_TRIANGLES, Float64Array, elsewhere, malformed, unsupported

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_MAX_ITEMS = 3 * MAX_TRIANGLES
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")


class Accessors:
    """Reads accessors of ``document``; ``binary`` is the file's binary chunk."""

    def __init__(self, document: dict[str, Any], binary: memoryview) -> None:
        self._accessors = document.get("accessors", [])
        self._views = document.get("bufferViews", [])
        self._buffers = document.get("buffers", [])
        self._binary = binary

    def array(self, number: object, width: int) -> Float64Array:
        """The items (N, width) of accessor ``number``.

        Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED or MESH_EXTERNAL_REFERENCE.
        """
        accessor = self._accessors[_whole(number)]
        component = _COMPONENTS.get(accessor["componentType"])
        if component is None or _WIDTHS.get(accessor["type"]) != width:
            raise malformed("a glTF accessor of an unexpected type")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise unsupported("the glTF file has a sparse accessor, which is not supported")
        count, item = _whole(accessor["count"]), np.dtype(component).itemsize * width
        if count > _MAX_ITEMS:
            raise malformed(f"a glTF accessor of {count} items")
        view = self._views[_whole(accessor["bufferView"])]
        data = self._view(view)
        stride = _whole(view.get("byteStride", item))
        start = _whole(accessor.get("byteOffset", 0))
        if stride < item or start + stride * max(count - 1, 0) + item * min(count, 1) > len(data):
            raise malformed("a glTF accessor reaches beyond its buffer view")
        items = np.ndarray((count, width), component, data, start, (stride, np.dtype(component).itemsize))
        return _scaled(items.astype(np.float64), component, bool(accessor.get("normalized", False)))

    def _view(self, view: dict[str, Any]) -> memoryview:
        if any(name in view.get("extensions", {}) for name in _COMPRESSED):
            raise unsupported("the glTF file's buffers are compressed: export it without mesh compression")
        buffer = self._buffers[_whole(view["buffer"])]
        if "uri" in buffer:
            raise elsewhere("the glTF file keeps its geometry in another file or address: export it as one .glb")
        if _whole(view["buffer"]) != 0:
            raise malformed("a glTF buffer without data")
        start, size = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        if start + size > min(len(self._binary), _whole(buffer["byteLength"])):
            raise malformed("a glTF buffer view reaches beyond its buffer")
        return self._binary[start : start + size]


def _scaled(items: Float64Array, component: str, normalized: bool) -> Float64Array:
    if not normalized or component == "<f4":
        return items
    top = float(np.iinfo(np.dtype(component)).max)
    return np.maximum(items / top, -1.0)


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 48:
        raise malformed("a glTF count, offset or index that is not a number")
    return value
