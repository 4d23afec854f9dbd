"""LAS and LAZ files that laspy wrote: the points are those that were given, and a damaged file is refused."""

from __future__ import annotations

import io
from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

from regnf_core.importing.meshes import las, read_mesh, thinning
from tests.core.importing.archives import assert_refused, saved
from tests.core.importing.in_process import convert
from tests.core.importing.meshes.test_point_clouds import directions

PLACE = np.array([530_000.0, 180_000.0, 35.0])
"""As in a national grid: single precision would lose millimeters."""


def written(points: NDArray[np.float64], compressed: bool) -> bytes:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), PLACE
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    out = io.BytesIO()
    cloud.write(out, do_compress=compressed, laz_backend=laspy.LazBackend.Lazrs if compressed else None)
    return out.getvalue()


@pytest.mark.parametrize("compressed", [False, True], ids=["las", "laz"])
def test_points_are_those_that_were_written(compressed: bool, tmp_path: Path) -> None:
    points = PLACE + directions(3000)
    data = written(points, compressed)
    found = read_mesh("las", memoryview(data))
    np.testing.assert_allclose(found.vertices, points, rtol=0, atol=1e-4)
    report = convert(saved(tmp_path, data), tmp_path / "out", None)
    assert report["family"] == "point_cloud"
    assert report["why"][0] == "a las file: 3000 points without normals"


def test_of_many_points_some_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MOST_KEPT", 1000)
    monkeypatch.setattr(las, "_AT_ONCE", 900)
    found = read_mesh("las", memoryview(written(PLACE + directions(3000), compressed=True)))
    assert 1000 <= len(found.vertices) <= 1004
    assert found.left_out == ("2 of each 3 points",)


@pytest.mark.parametrize("compressed", [False, True], ids=["las", "laz"])
def test_a_damaged_file_is_refused(compressed: bool) -> None:
    data = written(PLACE + directions(3000), compressed)
    for damaged in (data[:-500], data[:300], data[:100], data[:4] + b"\xff" * 200 + data[204:]):
        assert_refused(lambda damaged=damaged: read_mesh("las", memoryview(damaged)), "MESH_INVALID")
