"""E57 (ASTM E2807): scans of laser scanners, read by pye57 in parts, each moved by its pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from regnf_core.importing.assumptions import METERS, SCENE
from regnf_core.importing.meshes.thinning import Thinning
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, malformed, unsupported

_AT_ONCE = 500_000
_MOST_SCANS = 10_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ", "cartesianInvalidState")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation", "sphericalInvalidState")
_GRID = ("rowIndex", "columnIndex")


def read_e57(path: Path) -> Geometry:
    """The points of all scans of a file, in its common frame, and from where each was measured. Memory does not grow
    with their number.

    Raises FieldFormatError: MESH_INVALID, FORMAT_NOT_SUPPORTED.
    """
    try:
        from pye57 import libe57
    except ImportError as error:  # its authors publish no build for Linux on ARM
        raise unsupported("an E57 file, which is not read on this machine; export it as .las, .ply or .pcd") from error

    try:
        file = libe57.ImageFile(str(path), "r")
        try:
            scans = file.root()["data3D"]
            if len(scans) > _MOST_SCANS:
                raise unsupported(f"the E57 file has {len(scans)} scans; at most {_MOST_SCANS} are read")
            return _read(libe57, file, [scans[number] for number in range(len(scans))])
        finally:
            file.close()
    except libe57.E57Exception as error:
        raise malformed(f"the E57 file cannot be read: {str(error)[:200]}") from error
    except (AttributeError, TypeError, ValueError, RuntimeError, LookupError, OverflowError) as error:
        raise malformed("the E57 file is damaged") from error


def _read(libe57: Any, file: Any, scans: list[Any]) -> Geometry:
    thinning = Thinning(sum(scan["points"].childCount() for scan in scans))
    points, sensors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    read = 0
    for scan in scans:
        stored = scan["points"]
        kinds = libe57.StructureNode(stored.prototype())
        names = next((one for one in (_CARTESIAN, _SPHERICAL) if all(map(kinds.isDefined, one[:3]))), None)
        if names is None:
            raise unsupported("a scan of the E57 file has neither Cartesian nor spherical coordinates")
        turn, place = _pose(scan)
        buffers, into = libe57.VectorSourceDestBuffer(), []
        for name in filter(kinds.isDefined, names):
            into.append(np.zeros(_AT_ONCE, np.float64))
            buffers.append(libe57.SourceDestBuffer(file, name, into[-1], _AT_ONCE, True, True))
        reader = stored.reader(buffers)
        # A merged cloud has an identity for its pose, and no grid; a scanner's own frame begins at the scanner.
        is_known = place.any() or names is _SPHERICAL or all(map(kinds.isDefined, _GRID))
        while count := reader.read():
            kept = thinning.kept(read, read + count)
            read += count
            columns = np.stack(into)[:, kept]
            columns = columns[:, columns[3] == 0.0] if len(columns) > 3 else columns
            points.append(_places(names is _SPHERICAL, columns[:3]) @ turn.T + place)
            sensors.append(np.broadcast_to(place if is_known else np.nan, points[-1].shape))
        reader.close()
    if read < thinning.count:
        raise malformed(f"the E57 file ends before the {thinning.count} points of its scans")
    sensor = np.concatenate(sensors)
    known = sensor if np.isfinite(sensor).any() else None
    return Geometry(
        np.concatenate(points),
        np.zeros((0, 3), np.int64),
        left_out=thinning.left_out,
        sensor=known,
        assumes=(METERS, SCENE),
    )


def _places(is_spherical: bool, columns: Float64Array) -> Float64Array:
    """(N, 3) from columns (3, N): x, y, z, or range, azimuth and elevation in radians."""
    if not is_spherical:
        return columns.T
    length, azimuth, elevation = columns
    flat = length * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(elevation)], axis=1)


def _pose(scan: Any) -> tuple[Float64Array, Float64Array]:
    """Rotation (3, 3) and translation (3,) of a scan into the file's frame; none where it states none."""
    turn, place = np.eye(3), np.zeros(3)
    if not scan.isDefined("pose"):
        return turn, place
    if scan.isDefined("pose/rotation"):
        w, *axis = (float(scan["pose"]["rotation"][name].value()) for name in "wxyz")
        norm = float(np.linalg.norm([w, *axis]))
        if not 0.5 < norm < 2.0:
            raise malformed("the pose of an E57 scan is not a rotation")
        w, (x, y, z) = w / norm, np.array(axis) / norm
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + 2.0 * (w * cross + cross @ cross)
    if scan.isDefined("pose/translation"):
        place = np.array([float(scan["pose"]["translation"][name].value()) for name in "xyz"])
    if not np.isfinite(place).all():
        raise malformed("the pose of an E57 scan is not finite")
    return turn, place
