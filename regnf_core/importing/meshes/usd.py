"""USD scenes: meshes, basic shapes and instances at their poses, at the first time there is, by Pixar's library.

The library never looks for a file: each layer is read by itself, references to layers that came with it are put in
place of their names, and all others are removed. So nothing outside of what was given is opened.
"""

from __future__ import annotations

import posixpath
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.importing.containers.zip_members import DEFLATED, STORED, read_members
from regnf_core.importing.meshes.scene import Nodes, Part, assembled, in_meters, required, solid
from regnf_core.importing.meshes.triangle_files import (
    Float64Array,
    Geometry,
    Int64Array,
    Siblings,
    malformed,
    polygons,
    require_room,
)

_ENDS = (".usd", ".usda", ".usdc")
_MOST_LAYERS = 1000
_UNITS = {1.0: "meter", 0.1: "decimeter", 0.01: "centimeter", 0.001: "millimeter", 0.0254: "inch", 0.3048: "foot"}
_DRAWN = ("default", "render")
"""Purposes of what is part of the scene; others are guides and stand-ins."""


def read_usd(data: memoryview, siblings: Siblings | None = None, node: str | None = None) -> Geometry:
    """The triangles of a USD scene or package, in meters if it states its unit. siblings: layers that came with it ·
    node: the path of the prim to read.

    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, FORMAT_NOT_SUPPORTED without usd-core, INVALID_DESCRIPTION.
    """
    required("pxr", "a USD scene")
    from pxr import Tf, Usd

    layers, name = dict(siblings or {}), ""
    if bytes(data[:2]) == b"PK":
        members = read_members(data, (STORED, DEFLATED), folders=True)
        layers = {one.name: data[one.offset : one.offset + one.packed_size] for one in members if one.method == STORED}
        name = members[0].name
        data = layers.get(name, memoryview(b""))
    try:
        loaded = _Layers(layers)
        return _Scene(Usd.Stage.Open(loaded.load(name, data)), node).geometry(loaded.missing)
    except Tf.ErrorException as error:
        raise malformed("the USD file is damaged") from error


_SOLIDS = {
    "Cube": ("box", "size", "size", "size"),
    "Sphere": ("sphere", "radius"),
    "Cylinder": ("cylinder", "radius", "height"),
    "Capsule": ("capsule", "radius", "height"),
    "Cone": ("cone", "radius", "height"),
}
"""Basic shapes, and the attributes that have their sizes."""


class _Layers:
    """Layers by the names under which they came, each without references to what did not come."""

    def __init__(self, given: Mapping[str, memoryview]) -> None:
        self._given = given
        self._loaded: dict[str, Any] = {}
        self.missing = False
        """Whether references were removed."""

    def load(self, name: str, data: memoryview) -> Any:
        """The layer ``name``, with those that it refers to. Raises FieldFormatError (MESH_INVALID)."""
        root = self._read(name, data)
        waiting = [(name, root)]
        while waiting:
            name, layer = waiting.pop()
            for path in filter(None, layer.GetCompositionAssetDependencies()):  # "" is the layer itself
                wanted = posixpath.normpath(posixpath.join(posixpath.dirname(name), path))
                if wanted not in self._loaded and wanted in self._given and wanted.lower().endswith(_ENDS):
                    waiting.append((wanted, self._read(wanted, self._given[wanted])))
                known = self._loaded.get(wanted)
                self.missing |= known is None
                layer.UpdateCompositionAssetDependency(path, "" if known is None else known.identifier)
        return root

    def _read(self, name: str, data: memoryview) -> Any:
        from pxr import Sdf

        if len(self._loaded) >= _MOST_LAYERS:
            raise malformed(f"a USD scene of more than {_MOST_LAYERS} layers")
        layer = self._loaded[name] = Sdf.Layer.CreateAnonymous("layer.usd")
        with tempfile.NamedTemporaryFile(suffix=".usd") as file:  # the library reads binary layers from files alone
            file.write(data)
            file.flush()
            if not layer.Import(file.name):
                raise malformed("the USD file is damaged, or none")

        def without_clips(path: Any) -> None:
            if path.IsPrimPath() and layer.GetObjectAtPath(path).HasInfo("clips"):
                layer.GetObjectAtPath(path).ClearInfo("clips")  # values in other files

        layer.Traverse(Sdf.Path.absoluteRootPath, without_clips)
        return layer


class _Scene:
    """The prims of a stage that are drawn, with the places of each."""

    def __init__(self, stage: Any, asked: str | None) -> None:
        from pxr import Usd, UsdGeom

        self._usd, self._geom, self._stage, self._asked = Usd, UsdGeom, stage, asked
        self._time = Usd.TimeCode.EarliestTime()
        self._nodes = Nodes()
        self._shapes: list[tuple[int, Any, Float64Array]] = []
        self._other: set[str] = set()

    def geometry(self, missing: bool) -> Geometry:
        """What the stage has. missing: whether parts of it are in files that did not come."""
        stage, said = self._stage, self._stage.HasAuthoredMetadata
        self._find(stage.GetPseudoRoot(), np.eye(4)[None], -1)
        read, notes = self._nodes.chosen(self._asked)
        scale = float(self._geom.GetStageMetersPerUnit(stage)) if said("metersPerUnit") else 1.0
        if not 0.0 < scale < np.inf:
            raise malformed("the USD file has an invalid metersPerUnit")
        unit = in_meters(_UNITS.get(round(scale, 9), f"a unit of {scale:g} meters"))
        resized = np.diag([scale, scale, scale, 1.0])
        parts = (
            Part(*self._triangles(prim), resized @ matrices) for number, prim, matrices in self._shapes if read[number]
        )
        up = str(self._geom.GetStageUpAxis(stage)).lower() if said("upAxis") else None
        told = (*notes, unit if said("metersPerUnit") else "the file states no unit")
        lost = ["references to files that did not come with it"] * missing
        found = assembled(parts, up_axis=up, notes=told, assumes=())
        return replace(found, not_applied=(*sorted(self._other), *lost))

    def _find(self, root: Any, places: Float64Array, above: int) -> None:
        """Note the shapes below a prim that has these places (I, 4, 4)."""
        waiting = [(child, places, above) for child in self._children(root)]
        while waiting:
            prim, places, above = waiting.pop()
            if prim.IsA(self._geom.Imageable):
                image = self._geom.Imageable(prim)
                hidden = image.GetVisibilityAttr().Get(self._time) == "invisible"
                if hidden or image.GetPurposeAttr().Get() not in _DRAWN:
                    continue
            if prim.IsA(self._geom.Xformable):
                movable = self._geom.Xformable(prim)
                places = np.eye(4)[None] if movable.GetResetXformStack() else places
                places = places @ np.array(movable.GetLocalTransformation(self._time)).T
            shape = prim.IsA(self._geom.Gprim)
            number = self._nodes.add(prim.GetName(), above, int(shape))
            if shape:
                self._shapes.append((number, prim, places))
            if prim.IsA(self._geom.PointInstancer):
                waiting.extend(self._instances(prim, places, number))
            else:
                waiting.extend((child, places, number) for child in self._children(prim))

    def _children(self, prim: Any) -> list[Any]:
        return list(prim.GetFilteredChildren(self._usd.TraverseInstanceProxies()))

    def _instances(self, prim: Any, places: Float64Array, above: int) -> Iterator[tuple[Any, Float64Array, int]]:
        """The prototypes of instances, with the places of each."""
        many = self._geom.PointInstancer(prim)
        kinds = np.asarray(many.GetProtoIndicesAttr().Get(self._time) or [], np.int64)
        told = self._time, self._time, many.ExcludeProtoXform, many.IgnoreMask
        local = np.asarray(many.ComputeInstanceTransformsAtTime(*told), np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(local) != len(kinds):
            raise malformed("USD instances with different counts")
        if len(mask := np.asarray(many.ComputeMaskAtTime(self._time), bool)) == len(kinds):
            kinds = np.where(mask, kinds, -1)
        require_room(0, len(places) * len(local))
        for kind, path in enumerate(many.GetPrototypesRel().GetTargets()):
            if prototype := self._stage.GetPrimAtPath(path):
                yield prototype, (places[:, None] @ local[kinds == kind]).reshape(-1, 4, 4), above

    def _triangles(self, prim: Any) -> tuple[Float64Array, Int64Array]:
        """A shape in its own frame; nothing for one that is not read, which is noted."""
        kind, time = prim.GetTypeName(), self._time

        def value(name: str) -> Any:
            return prim.GetAttribute(name).Get(time)

        if kind == "Mesh":
            counts, corners = (np.asarray(value(f"faceVertex{name}") or [], np.int64) for name in ("Counts", "Indices"))
            require_room(len(value("points") or []), len(corners) // 3)
            if holes := value("holeIndices"):
                sound = ~np.isin(np.arange(len(counts)), np.asarray(holes))
                counts, corners = counts[sound], corners[np.repeat(sound, counts)]
            faces = polygons(counts, corners)
            flipped = value("orientation") == "leftHanded"
            if prim.GetAttribute("subdivisionScheme").HasAuthoredValue() and value("subdivisionScheme") != "none":
                self._other.add("the smooth surfaces of subdivision (their control meshes are read)")
            places = np.asarray(value("points") or [], np.float64).reshape(-1, 3)
            return places, faces[:, ::-1] if flipped else faces
        if kind in _SOLIDS:
            shape, *sizes = _SOLIDS[kind]
            places, faces = solid(shape, *(float(value(size)) for size in sizes))
            turns = {"X": [2, 0, 1], "Y": [1, 2, 0]}.get(value("axis") if prim.HasAttribute("axis") else "Z")
            return places if turns is None else places[:, turns], faces
        self._other.add(f"{kind} prims")
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
