"""The estimate of a reconstruction: the cells with points decide, and too many of them mean a coarser surface."""

from __future__ import annotations

import numpy as np

from regnf_core.importing.cost.mesh_work import affordable_depth
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.upload_description import UploadDescription
from tests.core.importing.archives import assert_refused
from tests.core.importing.meshes.test_point_clouds import directions, ply

ALLOWED_S = 60.0


def test_a_dense_scan_is_reconstructed_as_finely_as_can_be() -> None:
    assert affordable_depth(directions(300_000), ALLOWED_S) == 8


def test_points_that_fill_a_volume_are_reconstructed_coarsely() -> None:
    """The finest level takes 68 s at least, and its 2.3 million triangles take longer still."""
    noise = np.random.default_rng(0).random((300_000, 3))
    assert affordable_depth(noise, ALLOWED_S) == 6
    assert affordable_depth(np.concatenate([noise[:1000]] * 300), ALLOWED_S) == 8, "repeated points are one cell"


def test_a_line_and_a_plane_are_measured_too() -> None:
    line = np.linspace(0.0, 1.0, 5000)[:, None] * np.eye(3)[0]
    assert affordable_depth(line, ALLOWED_S) == 8
    assert affordable_depth(line, 233 * 2.5e-4 * 0.9) == 7


def test_what_is_affordable_decides_over_the_width_and_the_report_says_so() -> None:
    around = directions(4000)
    data = memoryview(ply(around, around))
    fine, coarse = (convert_mesh("ply", data, UploadDescription(), work_s) for work_s in (ALLOWED_S, 0.9))
    assert "256 cells wide" in fine.why[1]
    assert "instead of" not in fine.warnings[0]
    assert "32 cells wide" in coarse.why[1]
    assert "it is 32 cells wide instead of 256" in coarse.warnings[0]
    assert_refused(lambda: convert_mesh("ply", data, UploadDescription(), 0.1), "IMPORT_TOO_COSTLY")
