"""Fields from data in memory: arrays of a mesh, points or a grid, functions, and meshes of trimesh and Open3D.

They are made by the import's own converters, so a mesh in memory is the same field as the same mesh in a file. Nothing
runs in a sandbox: the numbers are the caller's own. Objects of other libraries are told by their attributes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError, InvalidInputError

if TYPE_CHECKING:
    from regnf_core.field_source import Role
    from regnf_core.fields.observation import SdfField
    from regnf_core.fields.user_fields import PointFunction
    from regnf_core.importing.families.converted import ConvertedField
    from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, Int64Array

HINT = (
    'Give a path such as "chair.glb", a mesh or point cloud of trimesh or Open3D, a field from open_field, from_mesh,'
    " from_points, from_grid or from_function, or an object with SdfField's members."
)
_NUMBERS = "Give an array, a tensor or a list of real numbers whose rows have the same length."
_SIGN = (
    "Values are distances, positive in free space. If they are negative there, say sign=-1 (from_grid:"
    ' description={"sign": -1}). Check also that the bounds contain the surface and some free space around it.'
)
Said = Mapping[str, Any] | None
"""What ``open_field`` takes as a description: up_axis, world_scale, sign, as ..."""


class HasVertices(Protocol):
    """A mesh of trimesh or Open3D."""

    @property
    def vertices(self) -> Any: ...


class HasPoints(Protocol):
    """A cloud of Open3D."""

    @property
    def points(self) -> Any: ...


class HasGeometry(Protocol):
    """A scene of trimesh."""

    @property
    def geometry(self) -> Any: ...


class FieldWarning(UserWarning):
    """The import of an opened field has a warning."""


def from_mesh(vertices: Any, faces: Any, colors: Any = None, description: Said = None) -> SdfField:
    """The exact distance to a triangle mesh, as of a mesh file.

    vertices: (V, 3) numbers · faces: (F, 3) or (F, 4) indices from 0, or a list of polygons · colors: (V, 3) in 0..1 or
    0..255. Lists, numpy arrays and tensors of any device, order and real dtype are taken, float64 with all its digits.
    Vertices that are not finite, triangles without an area and repeated ones are left out, as of a file.
    Raises FieldFormatError: MESH_INVALID, MESH_TOO_LARGE, NO_ZERO_LEVEL, INVALID_DESCRIPTION.
    """
    places = _rows("vertices", vertices, "MESH_INVALID")
    corners = _faces(faces, len(places))
    painted = None if colors is None else _colors(colors, len(places))
    return _mesh(places, corners, painted, description)


def from_points(points: Any, normals: Any = None, description: Said = None, sensor: Any = None) -> SdfField:
    """The field of a point cloud: the distance to its screened Poisson surface.

    points, normals: (N, 3), as ``from_mesh`` takes vertices; rows that are not finite, or of no normal, are left out.
    Normals point to free space. Missing or contradicting normals are estimated: they point to the ``sensor`` (3,), the
    position from which all points were measured, or without it to positions from which the points are visible.
    Raises FieldFormatError: MESH_INVALID, POINT_CLOUD_TOO_SMALL, NO_ZERO_LEVEL, INVALID_DESCRIPTION.
    """
    from regnf_core.importing.families.cloud import convert_cloud
    from regnf_core.importing.meshes.triangle_files import Geometry, require_room

    places = _rows("points", points, "MESH_INVALID")
    along = None if normals is None else _rows("normals", normals, "MESH_INVALID")
    place = None if sensor is None else _array("sensor", sensor, "MESH_INVALID").astype(np.float64)
    if place is not None and (place.shape != (3,) or not np.isfinite(place).all()):
        raise FieldFormatError(f"sensor has shape {place.shape}, expected three numbers", reason="MESH_INVALID")
    if along is not None and len(along) != len(places):
        raise FieldFormatError(f"{len(along)} normals for {len(places)} points", reason="MESH_INVALID")
    require_room(len(places), 0)
    geometry = Geometry(places, np.zeros((0, 3), np.int64), along, sensor=place)
    return _field(convert_cloud(geometry, "points in memory", _said(description)), description)


def from_grid(values: Any, origin: Any, spacing: Any, description: Said = None) -> SdfField:
    """The field of distances at the nodes of a regular grid, interpolated between them.

    values: (X, Y, Z) real numbers, the first axis x, positive in free space · origin: (3,), the place of node (0, 0, 0)
    · spacing: (3,) or one number, from node to node; both in the field's unit, as the values are.
    Raises FieldFormatError: TENSOR_SHAPE, TENSOR_DTYPE, TENSOR_NOT_FINITE, BOUNDS_INVALID, NO_ZERO_LEVEL,
    FIELD_IMPLAUSIBLE, INVALID_DESCRIPTION.
    """
    from regnf_core.importing.arrays import finite_float32
    from regnf_core.importing.families.dense_grid import grid_field

    array = _array("values", values, "TENSOR_DTYPE")
    if array.ndim != 3 or min(array.shape) < 2:
        message = f"values has shape {array.shape}, expected (X, Y, Z) with at least two nodes per axis"
        raise FieldFormatError(message, reason="TENSOR_SHAPE")
    place, step = (_array(name, one, "BOUNDS_INVALID") for name, one in (("origin", origin), ("spacing", spacing)))
    step = np.full(3, float(step.reshape(()))) if step.size == 1 else step
    for name, vector in (("origin", place), ("spacing", step)):
        if vector.shape != (3,):
            raise FieldFormatError(f"{name} has shape {vector.shape}, expected (3,)", reason="BOUNDS_INVALID")
    numbers = np.ascontiguousarray(finite_float32("values", array.astype(np.float64)))
    why = ("values in memory",)
    converted = grid_field(numbers, place.astype(np.float64), step.astype(np.float64), why, _said(description))
    return _field(converted, description)


def from_function(f: PointFunction, bounds: Any, sign: int = 1, device: str | None = None) -> SdfField:
    """The field of a function of points, for instance a torch module.

    f: is given points (N, 3), a float32 tensor on ``device``, in batches of at most 262,144, and returns the signed
    distance (N,) or (N, 1) of each, a tensor or a numpy array · bounds: (2, 3), lowest and highest corner of the region
    where it has meaning, same unit · sign: 1 where it is positive in free space, -1 where it is negative there ·
    device: None takes that of a module's parameters, else the CPU.
    The gradient is autograd's where f is made of torch's operations, else a central difference.
    Raises FieldFormatError: FUNCTION_UNUSABLE (it raises, or returns something else), BOUNDS_INVALID,
    FIELD_NOT_FINITE, FIELD_NOT_A_FUNCTION, NO_ZERO_LEVEL, FIELD_IMPLAUSIBLE.
    """
    from regnf_core.fields.user_fields import FunctionOfPoints

    if not callable(f):
        message = f"the function is {_kind(f)}, which cannot be called"
        raise FieldFormatError(message, reason="FUNCTION_UNUSABLE", hint="Write from_function(f, bounds).")
    field = FunctionOfPoints(f, bounds, sign, device)
    for warning in _checked(field, sign):
        warnings.warn(warning, FieldWarning, stacklevel=2)
    return field


def field_of(thing: Any, role: Role | None = None, description: Said = None) -> SdfField:
    """The field of a mesh or point cloud of any supported library. role: its use.

    Raises InvalidInputError (NO_FIELD) for what is none, and what the functions above raise.
    """
    from regnf_core.fields.observation import SdfField

    said = dict(description or {})
    if role is not None and "as" not in said:
        said["as"] = role
    if isinstance(thing, SdfField) and not isinstance(thing, type):
        if type(thing).__module__.partition(".")[0] in ("regnf_core", "regnf_fit", "regnf_data"):
            return thing
        from regnf_core.fields.user_fields import UserField

        return UserField(thing)  # is given float32 points, and what it returns is checked
    geometry = geometry_of(thing, role)
    if len(geometry.faces) == 0:
        return from_points(geometry.vertices, geometry.normals, said)
    return _mesh(geometry.vertices, geometry.faces, geometry.colors, said)


def geometry_of(thing: Any, role: Role | None = None) -> Geometry:
    """The triangles or points of a mesh of another library, or of a mesh that regnf has opened. Torch-free.

    Raises InvalidInputError (NO_FIELD) for what has none, FieldFormatError (MESH_INVALID).
    """
    from regnf_core.importing.meshes.triangle_files import Geometry

    if isinstance(thing, type):
        raise _no_field(f"the class {thing.__name__}", role)
    if callable(getattr(thing, "dump", None)) and hasattr(thing, "geometry"):  # trimesh.Scene
        return _scene(thing, role)
    vertices = _first(thing, "vertices", "vertex.positions")
    faces = _first(thing, "faces", "triangles", "triangle.indices")
    if vertices is not None and faces is not None:
        places = _rows("vertices", vertices, "MESH_INVALID")
        return Geometry(places, _faces(faces, len(places)), colors=_vertex_colors(thing, len(places)))
    points = _first(thing, "points", "point.positions")
    if points is not None:
        normals = _first(thing, "normals", "point.normals")
        given = None if normals is None or len(normals) == 0 else _rows("normals", normals, "MESH_INVALID")
        return Geometry(_rows("points", points, "MESH_INVALID"), np.zeros((0, 3), np.int64), given)
    asked = ("signed_distance", "signed_distance_and_gradient")
    missing = [name for name in ("bounds", "device", "to", *asked) if not hasattr(thing, name)]
    some = any(hasattr(thing, name) for name in asked)
    raise _no_field(_kind(thing), role, f": SdfField's {', '.join(missing)} is missing" if some else "")


def _mesh(places: Float64Array, corners: Int64Array, painted: Float64Array | None, description: Said) -> SdfField:
    from regnf_core.importing.families.triangles import mesh_field
    from regnf_core.importing.meshes.triangle_files import Geometry, require_room

    require_room(len(places), len(corners))
    geometry = Geometry(places, corners, colors=painted)
    return _field(mesh_field(geometry, "a mesh in memory", _said(description)), description)


def _scene(scene: Any, role: Role | None) -> Geometry:
    """All triangle meshes of a trimesh scene at their poses."""
    from regnf_core.importing.meshes.triangle_files import Geometry

    meshes = [one for one in scene.dump() if hasattr(one, "faces") and hasattr(one, "vertices")]
    if not meshes:
        raise _no_field(f"{_kind(scene)} without triangles", role)
    places = [_rows("vertices", one.vertices, "MESH_INVALID") for one in meshes]
    starts = np.cumsum([0, *map(len, places)])
    corners = [_faces(one.faces, len(at)) + start for one, at, start in zip(meshes, places, starts, strict=False)]
    return Geometry(np.concatenate(places), np.concatenate(corners))


def _field(converted: ConvertedField, description: Said) -> SdfField:
    """The field of what a converter made, checked as an import's is; warnings are issued as FieldWarnings."""
    from regnf_core.importing.families.converted import Reading
    from regnf_core.importing.gate.evidence import field_of as built
    from regnf_core.importing.gate.report import placed

    done = placed(converted, _said(description))
    field = built(Reading("", done.description, done.tensors))
    is_mesh = done.description["kind"] == "mesh"
    sign = None if is_mesh or _said(description).sign else int(done.description["sign"])
    insists = bool(_said(description).accept_implausible)
    for warning in (*done.warnings, *_checked(field, sign, is_mesh, insists)):
        warnings.warn(warning, FieldWarning, stacklevel=4)
    return field


def _checked(field: SdfField, sign: int | None, is_mesh: bool = False, insists: bool = False) -> list[str]:
    from regnf_core.importing.gate.plausibility import check_plausibility, require_plausible

    try:
        measured, found, _ = check_plausibility(field, is_mesh=is_mesh)
        if not insists:
            require_plausible(measured, sign)
    except FieldFormatError as error:
        if is_mesh or error.reason not in ("NO_ZERO_LEVEL", "FIELD_IMPLAUSIBLE"):
            raise
        raise FieldFormatError(str(error), reason=error.reason, hint=_SIGN) from error
    return found


def _said(description: Said) -> Any:
    from regnf_core.importing.upload_description import UploadDescription

    return UploadDescription.from_dict(None if description is None else dict(description))


def _array(name: str, values: Any, reason: str) -> npt.NDArray[Any]:
    """Real numbers as a numpy array. Raises FieldFormatError."""
    for method in ("detach", "cpu"):  # of torch and of Open3D's tensors
        values = getattr(values, method)() if callable(getattr(values, method, None)) else values
    if not isinstance(values, np.ndarray) and callable(getattr(values, "numpy", None)):
        values = values.float().numpy() if str(getattr(values, "dtype", "")) == "torch.bfloat16" else values.numpy()
    try:
        array = np.asarray(values)
    except Exception as error:  # rows of several lengths, or an object of another library
        raise FieldFormatError(f"{name} is not an array of numbers: {error}", reason=reason, hint=_NUMBERS) from error
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise FieldFormatError(f"{name} has masked entries", reason=reason, hint="Leave them out, or fill them.")
    if array.dtype.kind not in "fiu":
        what = "nothing" if values is None else array.dtype.name
        raise FieldFormatError(f"{name} holds {what}; real numbers are required", reason=reason, hint=_NUMBERS)
    return array


def _rows(name: str, values: Any, reason: str) -> Float64Array:
    """(N, 3) float64. Raises FieldFormatError."""
    array = _array(name, values, reason)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        hint = (
            f"Give {name}.T: one row per point."
            if array.ndim == 2 and array.shape[0] == 3
            else "Write one row per point: x, y, z."
        )
        raise FieldFormatError(f"{name} has shape {array.shape}, expected (N, 3)", reason=reason, hint=hint)
    return np.ascontiguousarray(array, dtype=np.float64)


def _faces(faces: Any, vertices: int) -> Int64Array:
    """(F, 3) indices of ``vertices``; polygons as fans. Raises FieldFormatError (MESH_INVALID)."""
    from regnf_core.importing.meshes.triangle_files import fan, fans

    rows = isinstance(faces, list | tuple) and all(isinstance(face, list | tuple | np.ndarray) for face in faces)
    if rows and len({len(face) for face in faces}) > 1:
        corners = np.concatenate([fan(_indices(face).reshape(-1)) for face in faces])
    else:
        array = _indices(faces)
        if array.ndim != 2 or len(array) == 0 or not 3 <= array.shape[1] <= 255:
            hint = "Give (F, 3) vertex indices, one row per triangle."
            if array.ndim == 1 and len(array) > 3 and array[0] in (3, 4):
                hint = "In PyVista: mesh.triangulate().regular_faces."
            elif array.ndim == 2 and array.shape[0] == 3:
                hint = "Give faces.T: one row per face."
            raise FieldFormatError(f"faces has shape {array.shape}, expected (F, 3)", reason="MESH_INVALID", hint=hint)
        corners = fans(array)
    if len(corners) == 0:
        raise FieldFormatError("there are no triangles", reason="MESH_INVALID")
    if corners.min() < 0 or corners.max() >= vertices:
        from_one = corners.min() == 1 and corners.max() == vertices
        hint = "They seem to start at 1: subtract 1." if from_one else "Indices start at 0."
        message = f"faces refer to the vertices {corners.min()} to {corners.max()}, there are 0 to {vertices - 1}"
        raise FieldFormatError(message, reason="MESH_INVALID", hint=hint)
    return corners


def _indices(values: Any) -> Int64Array:
    array = _array("faces", values, "MESH_INVALID")
    if array.dtype.kind == "f" and not (np.isfinite(array) & (array == np.round(array))).all():
        raise FieldFormatError("faces has numbers that are not whole", reason="MESH_INVALID")
    return array.astype(np.int64)


def _colors(colors: Any, vertices: int) -> Float64Array:
    """(V, 3) in [0, 1]. Raises FieldFormatError (MESH_INVALID)."""
    from regnf_core.importing.meshes.triangle_files import within_unit

    array = _array("colors", colors, "MESH_INVALID")
    if array.ndim != 2 or len(array) != vertices or array.shape[1] not in (3, 4):
        message = f"colors has shape {array.shape}, expected ({vertices}, 3)"
        raise FieldFormatError(message, reason="MESH_INVALID")
    whole = array.dtype.kind in "iu" or (array.size > 0 and float(np.nanmax(array)) > 1.0)
    return within_unit(array[:, :3].astype(np.float64), 255.0 if whole else 1.0)


def _vertex_colors(thing: Any, vertices: int) -> Float64Array | None:
    """Those that a mesh of trimesh or Open3D has of its own."""
    visual = getattr(thing, "visual", None)
    if visual is not None:
        return _colors(visual.vertex_colors, vertices) if getattr(visual, "kind", None) == "vertex" else None
    found = _first(thing, "vertex_colors", "vertex.colors")
    return None if found is None or len(found) != vertices else _colors(found, vertices)


def _first(thing: Any, *names: str) -> Any:
    """The first attribute that there is; ``vertex.positions`` is an entry of what is called ``vertex``, of Open3D."""
    for name in names:
        outer, _, inner = name.partition(".")
        found = getattr(thing, outer, None)
        if inner and found is not None:
            found = found[inner] if inner in found else None  # noqa: SIM401 -- Open3D's maps have no get
        if found is not None and not callable(found):
            return found
    return None


def _kind(thing: Any) -> str:
    """As its user knows it: with its library, unless that is Python's."""
    of, name = type(thing).__module__.partition(".")[0], type(thing).__name__
    return f"of the type {name}" if of in ("builtins", "__main__") else f"of the type {of} {name}"


def _no_field(what: str, role: Role | None, more: str = "") -> InvalidInputError:
    named = f"the {role}" if role else "the field"
    return InvalidInputError(f"{named} is {what}, expected a field or its path{more}", reason="NO_FIELD", hint=HINT)
