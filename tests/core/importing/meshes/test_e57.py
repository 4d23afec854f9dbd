"""E57 files that pye57 wrote: the points of all scans by their poses, and from where they were measured."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnf_core.fields.build import open_field
from regnf_core.fields.observation import observation_of
from regnf_core.importing.gate.convert import FIELD_NAME
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.meshes import e57, read_mesh, thinning
from regnf_core.schema.description import FREE
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.meshes.test_point_clouds import directions

pye57 = pytest.importorskip("pye57")
Array = NDArray[np.float64]
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])


def write(path: Path, *scans: tuple[Array, Array, Array], **columns: Array) -> Path:
    """Scans of points (N, 3) in the scanner's frame, a quaternion w x y z and a translation each."""
    with pye57.E57(str(path), "w") as file:
        for points, quaternion, place in scans:
            named = {f"cartesian{axis}": points[:, number] for number, axis in enumerate("XYZ")}
            file.write_scan_raw(named | columns, rotation=quaternion, translation=place)
    return path


def write_spherical(path: Path, points: Array) -> Path:
    """With the library's own nodes: its scans are Cartesian."""
    lib = pye57.libe57
    length = np.linalg.norm(points, axis=1)
    values = [
        length,
        np.arctan2(points[:, 1], points[:, 0]),
        np.arcsin(points[:, 2] / length),
    ]  # kept: they are written
    with pye57.E57(str(path), "w") as file:
        image = file.image_file
        kinds, buffers = lib.StructureNode(image), lib.VectorSourceDestBuffer()
        for name, column in zip(("Range", "Azimuth", "Elevation"), values, strict=True):
            kinds.set(f"spherical{name}", lib.FloatNode(image, 0.0, lib.E57_DOUBLE, -1e9, 1e9))
            buffers.append(lib.SourceDestBuffer(image, f"spherical{name}", column, len(column), True, True))
        stored = lib.CompressedVectorNode(image, kinds, lib.VectorNode(image, True))
        scan = lib.StructureNode(image)
        scan.set("points", stored)
        file.data3d.append(scan)
        writer = stored.writer(buffers)
        writer.write(len(points))
        writer.close()
    return path


def read(path: Path) -> tuple[Array, Array | None]:
    found = read_mesh("e57", memoryview(b""), path=path)
    return found.vertices, found.sensor


def test_scans_are_moved_by_their_poses_and_their_scanners_stood_there(tmp_path: Path) -> None:
    first, second = directions(700), 2.0 * directions(500)
    quaternion, place = np.roll(TURN.as_quat(), 1), np.array([4.0, -1.0, 0.5])
    path = write(tmp_path / "a.e57", (first, np.array([1.0, 0, 0, 0]), place), (second, quaternion, -place))
    points, sensor = read(path)
    expected = np.concatenate([first + place, TURN.apply(second) - place])
    np.testing.assert_allclose(points, expected, atol=1e-6)  # the writer keeps single precision
    assert sensor is not None
    np.testing.assert_array_equal(sensor, np.repeat([place, -place], [700, 500], axis=0))
    own = pye57.E57(str(path)).read_scan(1, ignore_missing_fields=True)
    np.testing.assert_allclose(points[700:, 0], own["cartesianX"], atol=1e-6)


def test_a_cloud_without_a_pose_and_a_grid_has_no_scanner(tmp_path: Path) -> None:
    points = directions(400)
    still = (points, np.array([1.0, 0, 0, 0]), np.zeros(3))
    assert read(write(tmp_path / "merged.e57", still))[1] is None
    rows = np.arange(400)
    _, sensor = read(write(tmp_path / "grid.e57", still, rowIndex=rows // 20, columnIndex=rows % 20))
    np.testing.assert_array_equal(sensor, np.zeros((400, 3)))


def test_points_that_the_scanner_calls_invalid_are_left_out(tmp_path: Path) -> None:
    points, lost = directions(300), np.arange(300) % 3 == 0
    still = (points, np.array([1.0, 0, 0, 0]), np.ones(3))
    found, _ = read(write(tmp_path / "a.e57", still, cartesianInvalidState=lost.astype(np.int8)))
    np.testing.assert_allclose(found, points[~lost] + 1.0, atol=1e-6)


def test_spherical_coordinates_are_read(tmp_path: Path) -> None:
    points = directions(300) * np.linspace(1.0, 5.0, 300)[:, None]
    found, sensor = read(write_spherical(tmp_path / "a.e57", points))
    np.testing.assert_allclose(found, points, atol=1e-12)
    np.testing.assert_array_equal(sensor, np.zeros((300, 3)))


def test_of_many_points_some_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MOST_KEPT", 500)
    monkeypatch.setattr(e57, "_AT_ONCE", 130)
    scan = (directions(800), np.array([1.0, 0, 0, 0]), np.ones(3))
    found = read_mesh("e57", memoryview(b""), path=write(tmp_path / "a.e57", scan, scan))
    assert found.left_out == ("3 of each 4 points",)
    kept = thinning.Thinning(1600).kept(0, 1600)
    np.testing.assert_allclose(found.vertices, np.tile(scan[0] + 1.0, (2, 1))[kept], atol=1e-6)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    data = write(tmp_path / "a.e57", (directions(900), np.array([1.0, 0, 0, 0]), np.ones(3))).read_bytes()
    for number, damaged in enumerate(
        (data[:-2000], data[:40], data[:5000] + bytes(100) + data[5100:], data.replace(b"data3D", b"data4D"), data[:8])
    ):
        path = saved(tmp_path, damaged, f"{number}.e57")
        assert_refused(lambda path=path: read(path), "MESH_INVALID")


def test_a_room_of_two_scans_is_imported_in_the_confined_process(tmp_path: Path) -> None:
    """Free space is within, where the scanners stood, though no option says that it is a room. Also in an archive."""
    ball, places = 3.0 * directions(1200), np.array([[1.0, 0.0, 0.0], [-1.0, 0.5, 0.0]])
    scans = [(ball[number::2] - place, np.array([1.0, 0, 0, 0]), place) for number, place in enumerate(places)]
    data = write(tmp_path / "a.e57", *scans).read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("scans/a.e57", data)
    for name, content in (("a.e57", data), ("a.zip", packed.getvalue())):
        report = import_field(saved(tmp_path, content, name), tmp_path / f"out-{name}", None, ImportLimits())
        assert report.family == "point_cloud"
        assert any("the position of the sensor" in warning for warning in report.warnings)
        field = open_field(tmp_path / f"out-{name}" / FIELD_NAME)
        probes = torch.from_numpy(np.concatenate([places, 0.6 * ball[:99], 1.1 * ball[:99]])).float()
        assert (field.signed_distance(probes) > 0).tolist() == [True] * 101 + [False] * 99
        seen = observation_of(field)
        assert seen is not None
        assert (seen.at(probes[:101]) == FREE).float().mean() > 0.9
        assert (seen.at(probes[101:]) != FREE).all()
