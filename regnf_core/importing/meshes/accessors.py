"""The numbers of a glTF document: accessors into its buffers, every extent checked first.

A buffer is the file's own binary chunk, text within the document, or a file that came with it. None is ever looked for.
"""

from __future__ import annotations

import base64
from typing import Any
from urllib.parse import unquote

import numpy as np

from regnf_core.importing.meshes.meshopt import decoded
from regnf_core.importing.meshes.scene import required
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
_DENIED_BY = 1e-3
"""A stated range that differs by so large a share of its largest number is not that of the numbers."""
DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
TRIANGLES = 4


class Accessors:
    """Reads accessors of ``document``. binary: the file's chunk, None in text form · siblings: files beside it."""

    def __init__(self, document: dict[str, Any], binary: memoryview | None, siblings: Siblings) -> None:
        self._accessors, self._views, self._buffers = (
            document.get(key, []) for key in ("accessors", "bufferViews", "buffers")
        )
        self._binary = binary
        self._siblings = siblings
        self._read: dict[int, memoryview] = {}
        self._unpacked: dict[int, memoryview] = {}
        self._decoded: dict[int, Float64Array] = {}

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
        if number in self._decoded:
            items = self._decoded[_whole(number)]
            if items.shape != (count, width):
                raise malformed("a glTF accessor contradicts its compressed mesh")
        elif "bufferView" in accessor:
            items = self._items(accessor, component, count, width)
        if "sparse" in accessor:
            said = accessor["sparse"]
            changed, type_ = _whole(said["count"]), _COMPONENTS.get(said["indices"]["componentType"])
            if type_ is None or type_[1] != "u" or changed > count:
                raise malformed("a glTF sparse accessor has too many items")
            at = self._items(said["indices"], type_, changed, 1).reshape(-1).astype(np.int64)
            if len(at) and at.max() >= count:
                raise malformed("a glTF sparse accessor refers to an item that does not exist")
            items[at] = self._items(said["values"], component, changed, width)
        if accessor.get("normalized", False) and component != "<f4":
            items = np.maximum(items / float(np.iinfo(np.dtype(component)).max), -1.0)
        return items

    def unpack(self, primitive: dict[str, Any]) -> None:
        """Decode what Draco has packed of a primitive; its accessors then give that."""
        packed, position = primitive.get("extensions", {}).get(DRACO), primitive["attributes"]["POSITION"]
        if packed is None or position in self._decoded or "bufferView" in self._accessors[_whole(position)]:
            return  # not compressed, or decoded before, or also there without compression
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            raise unsupported("the glTF file has triangle strips compressed by Draco: export it without compression")
        library = required("DracoPy", "a glTF file with Draco compression")
        try:
            mesh = library.decode(bytes(self._view(_whole(packed["bufferView"]))))
            for key, unique in packed["attributes"].items():
                items = np.asarray(mesh.get_attribute_by_unique_id(unique)["data"], np.float64)
                self._decoded[_whole(primitive["attributes"][key])] = items.reshape(len(items), -1)
            self._decoded[_whole(primitive["indices"])] = np.asarray(mesh.faces, np.float64).reshape(-1, 1)
        except (library.FileTypeException, AttributeError, RuntimeError, ValueError) as error:
            raise malformed("the glTF file's mesh is no sound Draco data") from error

    def denies(self, number: object) -> bool:
        """Whether the lowest and highest corner that an accessor states are not those of its numbers (N, 3)."""
        accessor = self._accessors[_whole(number)]
        told = "bufferView" in accessor and "sparse" not in accessor and "min" in accessor and "max" in accessor
        if not told or not accessor["count"] or accessor.get("normalized"):
            return False
        items, stated = self.array(number, 3), np.array([accessor["min"], accessor["max"]], np.float64)
        found = np.stack([items.min(axis=0), items.max(axis=0)])
        return bool(np.abs(found - stated).max() > _DENIED_BY * np.abs(stated).max())

    def _items(self, said: dict[str, Any], component: str, count: int, width: int) -> Float64Array:
        """(count, width) numbers of a buffer view, from a byte offset on."""
        number, item = _whole(said["bufferView"]), np.dtype(component).itemsize * width
        view, data = self._views[number], self._view(number)
        stride, start = _whole(view.get("byteStride", item)), _whole(said.get("byteOffset", 0))
        if stride < item or start + stride * max(count - 1, 0) + item * min(count, 1) > len(data):
            raise malformed("a glTF accessor extends beyond its buffer view")
        items = np.ndarray((count, width), component, data, start, (stride, np.dtype(component).itemsize))
        return items.astype(np.float64)

    def _view(self, number: int) -> memoryview:
        view = self._views[number]
        packed = next((view["extensions"][name] for name in MESHOPT if name in view.get("extensions", {})), None)
        if packed is None:
            return self._part(view)
        if number not in self._unpacked:
            count, stride = _whole(packed["count"]), _whole(packed["byteStride"])
            if count > _MAX_ITEMS:
                raise malformed(f"a glTF buffer view of {count} items")
            how = str(packed["mode"]), str(packed.get("filter", "NONE"))
            self._unpacked[number] = decoded(self._part(packed), count, stride, *how)
        return self._unpacked[number]

    def _part(self, said: dict[str, Any]) -> memoryview:
        """The bytes of a buffer that a view names."""
        data = self._buffer(_whole(said["buffer"]))
        start, size = _whole(said.get("byteOffset", 0)), _whole(said["byteLength"])
        if start + size > len(data):
            raise malformed("a glTF buffer view extends beyond its buffer")
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


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 1 << 48:
        raise malformed("a glTF count, offset or index that is not a number")
    return value
