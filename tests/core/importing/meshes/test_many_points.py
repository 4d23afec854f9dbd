"""Clouds of many points, in each format and in small parts, against the same points without a limit; and .npy files."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d
import pytest
from numpy.typing import NDArray

from regnf_core.field_files import require_field_file
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format
from regnf_core.importing.meshes import point_files, read_mesh, thinning
from regnf_core.importing.meshes.triangle_files import Geometry
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.meshes.mesh_files import converted, pcd
from tests.core.importing.meshes.test_point_clouds import directions

Array = NDArray[np.float64]
POINTS = directions(2400).astype(np.float32).astype(np.float64)


def npy(array: NDArray[np.generic], **options: bool) -> bytes:
    out = io.BytesIO()
    np.save(out, array, **options)
    return out.getvalue()


def by_open3d(name: str, **options: bool) -> Callable[[Path], bytes]:
    def write(folder: Path) -> bytes:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
        cloud.normals = open3d.utility.Vector3dVector(POINTS)
        assert open3d.io.write_point_cloud(str(folder / name), cloud, **options)
        return (folder / name).read_bytes()

    return write


WRITERS: dict[str, Callable[[Path], bytes]] = {
    "ply binary": by_open3d("a.ply"),
    "ply text": by_open3d("a.ply", write_ascii=True),
    "pcd binary": by_open3d("a.pcd"),
    "pcd text": by_open3d("a.pcd", write_ascii=True),
    "pcd compressed": by_open3d("a.pcd", compressed=True),
    "xyz": by_open3d("a.xyzn"),
    "pts": lambda _: (
        f"{len(POINTS)}\r\n".encode() + b"".join(b"%.9g %.9g %.9g -7 0 0 255\r\n" % tuple(p) for p in POINTS)
    ),
    "commas": lambda _: b"// x y z\n# 7\n" + b"".join(b"%.9g, %.9g; %.9g\n" % tuple(p) for p in POINTS),
    "npy": lambda _: npy(np.hstack([POINTS, POINTS]).astype(np.float32)),
    "npy by columns": lambda _: npy(np.asfortranarray(POINTS)),
}


def read(data: bytes) -> Geometry:
    format_ = sniff_format(data[:HEAD_BYTES])
    assert format_ is not None
    return read_mesh(format_, memoryview(data))


@pytest.mark.parametrize("format_", WRITERS)
def test_one_of_each_few_points_is_kept(format_: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = WRITERS[format_](tmp_path)
    whole = read(data)
    np.testing.assert_allclose(whole.vertices, POINTS, atol=1e-6)
    assert whole.left_out == ()
    monkeypatch.setattr(thinning, "MOST_KEPT", 500)
    monkeypatch.setattr(thinning, "_AT_ONCE", 1000)
    found = read(data)
    kept = thinning.Thinning(len(POINTS)).kept(0, len(POINTS))
    if format_ in ("xyz", "pts", "commas"):  # these state no count: that of the lines is taken
        kept = thinning.Thinning(len(POINTS) + 1).kept(0, len(POINTS))
    assert len(kept) == 480
    assert found.left_out == ("4 of each 5 points",)
    np.testing.assert_array_equal(found.vertices, whole.vertices[kept])
    if whole.normals is not None:
        np.testing.assert_array_equal(found.normals, whole.normals[kept])


@pytest.mark.parametrize("count", [0, 1, 499, 500, 501, 12_345])
def test_what_is_kept_does_not_depend_on_the_parts_and_favors_no_column(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thinning, "MOST_KEPT", 500)
    which = thinning.Thinning(count)
    whole = which.kept(0, count)
    cuts = [*range(0, count, 37), count]
    parts = [start + which.kept(start, stop) for start, stop in itertools.pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, np.int64), *parts]), whole)
    assert abs(len(whole) - count / which.step) <= 1
    if count == 12_345:
        per_column = np.bincount(whole % which.step, minlength=which.step)
        assert per_column.max() - per_column.min() <= 3


@pytest.mark.parametrize("format_", ["ply binary", "ply text", "pcd binary", "pcd text", "pcd compressed", "npy"])
def test_a_cloud_of_many_points_that_is_cut_off_is_refused(
    format_: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thinning, "MOST_KEPT", 500)
    data = WRITERS[format_](tmp_path)
    assert_refused(lambda: read(data[: len(data) * 2 // 3]), "MESH_INVALID")


def test_text_that_is_no_lines_of_numbers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "_AT_ONCE", 100)
    rows = b"1.25 2.5 3.75\n" * 40
    for faulty in (rows + 2 * b"1 2\n", rows + 2 * b"1 2 x\n", rows + b" " * 200 + b"\n" + rows):
        assert_refused(lambda faulty=faulty: read_mesh("xyz", memoryview(faulty)), "MESH_INVALID")


def test_a_compressed_cloud_does_not_unpack_to_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_files, "_MOST_UNPACKED", 1000)
    assert_refused(lambda: read(pcd(POINTS, None, "binary_compressed")), "MESH_TOO_LARGE")


def test_a_mesh_keeps_its_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MOST_KEPT", 2)
    ply = (
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n"
    )
    assert read(ply).vertices.shape == (4, 3)
    assert read(ply).faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        (np.zeros((4, 5, 6)), "FORMAT_NOT_SUPPORTED"),
        (np.zeros((200, 20), np.float32), "FORMAT_NOT_SUPPORTED"),
        (np.zeros((200, 3), np.int32), "FORMAT_NOT_SUPPORTED"),
        (np.zeros((200, 3), np.complex64), "TENSOR_DTYPE"),
        (np.array([{}, {}, {}]), "NPY_OBJECT_ARRAY"),
        (np.zeros(9, [("x", "f4")]), "NPY_MALFORMED"),
    ],
)
def test_an_array_that_is_no_cloud_is_refused(array: NDArray[np.generic], reason: str) -> None:
    data = npy(array)
    assert_refused(lambda: read(data), reason)
    assert_refused(lambda: read(data[:20]), "NPY_MALFORMED")


def test_an_array_is_imported_as_a_cloud() -> None:
    found = converted(npy(np.hstack([POINTS, POINTS])))
    assert (found.family, found.why[0]) == ("point_cloud", f"a npy file: {len(POINTS)} points with normals")
    colored = read(npy(np.hstack([POINTS, np.full(POINTS.shape, 0.2)])))
    assert colored.normals is None


def test_a_text_of_points_is_taken_by_its_content(tmp_path: Path) -> None:
    require_field_file(saved(tmp_path, WRITERS["commas"](tmp_path), "scan.txt"))
    assert_refused(
        lambda: require_field_file(saved(tmp_path, b"notes on a scan\n", "notes.txt")), "FORMAT_NOT_RECOGNIZED"
    )
    plan = saved(tmp_path, b"image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", "map.yaml")
    assert_refused(lambda: require_field_file(plan), "FORMAT_NOT_SUPPORTED")
