"""Meshes whose triangles overlap are costly in proportion to their number; sound ones are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from regnf_core.importing.cost.mesh_work import SAMPLES, calls_of_check, mesh_seconds, mesh_work
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.archives import assert_refused, saved

RANDOM = np.random.default_rng(0)
Corners = npt.NDArray[np.float64]


def stl(corners: Corners) -> bytes:
    records = np.zeros(len(corners), dtype=[("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")])
    records["corners"] = corners.reshape(-1, 9)
    return bytes(80) + np.uint32(len(corners)).tobytes() + records.tobytes()


COSTLY = {
    "triangles across all the space": RANDOM.uniform(-1, 1, (60_000, 3, 3)),
    "one triangle many times, nearly": np.eye(3) + RANDOM.normal(0, 1e-4, (60_000, 3, 3)),
}


@pytest.mark.parametrize("name", COSTLY)
def test_overlapping_triangles_are_refused_before_a_distance_is_computed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The winding number of 2,000 points alone would take half a minute and more."""
    monkeypatch.setattr("igl.FastWindingNumberBVH", lambda: pytest.fail("a tree was built"))
    path = saved(tmp_path, stl(COSTLY[name]))
    assert_refused(
        lambda: convert_file(path, tmp_path, None, ImportLimits(wall_s=100, work_s=20.0)), "IMPORT_TOO_COSTLY"
    )


def test_a_sound_mesh_of_as_many_triangles_is_quick() -> None:
    ball = trimesh.creation.icosphere(subdivisions=6)
    assert len(ball.faces) > 60_000
    sound = mesh_seconds(ball.vertices, ball.faces, 2_000)
    vertices = COSTLY["triangles across all the space"].reshape(-1, 3)
    assert sound < 1.0 < mesh_seconds(vertices, np.arange(len(vertices)).reshape(-1, 3), 2_000) / 20


def test_a_knot_in_a_large_box_is_costly_since_all_points_walk_to_it() -> None:
    """20,000 needles through one place, and two specks far away: hardly a random point comes near the needles."""
    ends, turns = RANDOM.normal(size=(2, 20_000, 3))
    ends /= np.linalg.norm(ends, axis=1)[:, None]
    needles = np.stack((ends, 1e-3 * turns - ends, -1e-3 * turns - ends), axis=1)
    specks = 1e-3 * np.eye(3) + np.array([[[-50.0]], [[50.0]]])
    vertices = np.concatenate((needles, specks)).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    assert mesh_seconds(vertices, faces, 26_000) < 5.0
    assert mesh_work(vertices, faces, calls_of_check(SAMPLES)) > 30.0


def test_what_is_no_mesh_is_left_to_those_who_refuse_it() -> None:
    triangle = np.eye(3)
    assert mesh_seconds(triangle, np.zeros((0, 3), np.int32), 100) == 0.0
    assert mesh_seconds(triangle, np.array([[0, 1, 9]]), 100) == 0.0
    assert mesh_seconds(triangle * np.nan, np.array([[0, 1, 2]]), 100) == 0.0
