"""Recordings for the viewer of rerun, read back with rerun's own reader."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

import regnf
from regnf_core.document import Considered, ConsideredPose
from regnf_core.viewing.recording import write_recording
from tests.cli.conftest import DATA
from tests.core.conftest import ChairRun

BOX = json.loads((DATA / "detection.json").read_text())
ROOM, CHAIR = DATA / "mix-room.safetensors", DATA / "armchair.safetensors"
PARENT_FROM_CHILD = 1
UP = 1
Rows = dict[str, list[dict[str, Any]]]


def rows_of(path: Path) -> Rows:
    """Every row of a recording by its entity, in the order of its steps; values that are static first."""
    found: Rows = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return {entity: sorted(rows, key=lambda row: row.get("step", -1)) for entity, rows in found.items()}


def matrix_of(row: dict[str, Any]) -> NDArray[np.float64]:
    """The 4x4 from an entity's coordinates to its parent's that a row of Transform3D says, by rerun's definition."""
    (turn,), (scale,), (place,) = (row[f"Transform3D:{name}"] for name in ("quaternion", "scale", "translation"))
    assert row["Transform3D:relation"] == [PARENT_FROM_CHILD]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() @ np.diag(scale)
    matrix[:3, 3] = place
    return matrix


def colors_of(row: dict[str, Any]) -> NDArray[np.int64]:
    """(N, 3) bytes of what rerun stores as 0xRRGGBBAA."""
    packed = np.array(row["Points3D:colors"], dtype=np.int64)
    return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1)


@pytest.fixture(scope="module")
def found() -> regnf.Registered:
    return regnf.register(ROOM, CHAIR, BOX | {"label": "armchair"}, {"up_axis": "y"}, seed=3)


@pytest.fixture(scope="module")
def rows(found: regnf.Registered, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    folder = tmp_path_factory.mktemp("recording")
    assert found.save_recording(folder / "new" / "chair.rrd") == folder / "new" / "chair.rrd"
    assert [path.name for path in (folder / "new").iterdir()] == ["chair.rrd"]
    return rows_of(folder / "new" / "chair.rrd")


def test_the_object_follows_the_course_of_the_registration(found: regnf.Registered, rows: Rows) -> None:
    steps = rows["/scene/object"]
    course = [found.T_object_scene_initial, *(one.T_object_scene for one in found.trace), found.T_object_scene]
    assert [row["step"] for row in steps] == list(range(len(found.trace) + 2))
    assert len(steps) > 10
    for row, T_object_scene in zip(steps, course, strict=True):
        np.testing.assert_allclose(matrix_of(row), np.linalg.inv(np.asarray(T_object_scene)), atol=2e-6)
    assert matrix_of(steps[-1])[:3, :3] == pytest.approx(np.asarray(found.T_scene_object)[:3, :3], abs=1e-6)
    said = [row["TextLog:text"] for row in rows["/course"]]
    assert said[0] == ["start of the refinement"]
    assert said[-1] == [f"result: {found.verdict}, {found.verdict_reason}"]


def test_points_are_those_of_the_result(found: regnf.Registered, rows: Rows) -> None:
    assert found.surroundings is not None
    for entity, points in (
        ("/scene/samples", found.scene_samples.points),
        ("/scene/surroundings", found.surroundings.points),
        ("/scene/object/samples", found.object_samples.points),
    ):
        assert np.array_equal(np.array(rows[entity][0]["Points3D:positions"], dtype=np.float32), points.float().numpy())


def test_in_the_end_the_object_has_the_colors_of_its_residuals(found: regnf.Registered, rows: Rows) -> None:
    start, end = rows["/scene/object/samples"]
    assert (start["step"], end["step"]) == (0, len(found.trace) + 1)
    assert colors_of(start).tolist() == [[242, 143, 51]]
    colors, residuals = colors_of(end), found.residuals["object_residuals"].abs().numpy()
    assert len(colors) == len(found.object_samples.points)
    assert colors[residuals.argmin()].tolist() == [46, 51, 117]  # dark blue
    brightness = colors.sum(1)
    assert np.corrcoef(brightness, np.minimum(residuals, 0.015 * found.metrics["object_diameter"]))[0, 1] > 0.95


def test_residuals_of_the_trace_are_scalars_in_object_units(found: regnf.Registered, rows: Rows) -> None:
    for entity, expected in (
        ("/residual/scene", [one.residual_scene for one in found.trace]),
        ("/residual/object", [one.residual_object * float(one.T_object_scene.scale) for one in found.trace]),
    ):
        assert [row["step"] for row in rows[entity]] == list(range(1, len(found.trace) + 1))
        assert [row["Scalars:scalars"] for row in rows[entity]] == [[pytest.approx(value)] for value in expected]


def test_box_and_axis_are_those_of_the_request(rows: Rows) -> None:
    (box,) = rows["/scene/detection"]
    assert box["Boxes3D:centers"] == [pytest.approx(BOX["center"])]
    assert box["Boxes3D:half_sizes"] == [pytest.approx([length / 2 for length in BOX["size"]])]
    assert box["Boxes3D:labels"] == ["armchair"]
    (axes,) = rows["/scene"]
    assert axes["ViewCoordinates:xyz"][0][1] == UP


def test_a_turned_box_is_recorded_turned(found: regnf.Registered, tmp_path: Path) -> None:
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    box = regnf.OrientedBox.from_center([1, 2, 3], [2, 4, 6], turn)
    (row,) = rows_of(write_recording(found, tmp_path / "turned.rrd", box))["/scene/detection"]
    assert Rotation.from_quat(row["Boxes3D:quaternions"][0]).as_matrix() == pytest.approx(turn, abs=1e-6)
    assert "Boxes3D:labels" not in row


def test_each_pose_that_was_judged_is_an_entity(found: regnf.Registered, tmp_path: Path) -> None:
    assert found.considered is not None
    first = found.considered.poses[0]
    other = ConsideredPose(found.T_object_scene_initial, "LOW_OVERLAP", {"probability": 0.0123})
    few = found.considered.object_points[:4]
    signs = found.considered.object_signs[:2, :4].clone().zero_()[[0, 0]]
    signs[1, 1] = 1
    both = replace(found, considered=Considered([first, other], few, few, signs, signs))
    rows = rows_of(both.save_recording(tmp_path / "two.rrd"))
    for number, pose in enumerate((first, other)):
        (placed,) = rows[f"/scene/considered/{number}"]
        expected = np.linalg.inv(np.asarray(pose.T_object_scene))
        np.testing.assert_allclose(matrix_of(placed), expected, atol=2e-6)
        (samples,) = rows[f"/scene/considered/{number}/samples"]
        assert np.array_equal(np.array(samples["Points3D:positions"], dtype=np.float32), few.float().numpy())
    assert samples["Points3D:labels"] == ["1.2 %, LOW_OVERLAP"]
    colors = colors_of(samples)
    assert (colors[[0, 2, 3]] == colors[0]).all()
    assert colors[1].tolist() == [209, 33, 28]  # in free space
    assert "| 1 | 1.2 % | LOW_OVERLAP |" in rows["/verdict"][0]["TextDocument:text"][0]


def test_the_verdict_is_a_text(found: regnf.Registered, rows: Rows) -> None:
    (text,) = rows["/verdict"][0]["TextDocument:text"]
    assert rows["/verdict"][0]["TextDocument:media_type"] == ["text/markdown"]
    assert text.startswith(f"# {found.verdict}\n\n**{found.verdict_reason}**: ")
    assert found.probability is not None
    assert f"{100 * found.probability:.1f} %" in text
    assert str(CHAIR) in text


def test_a_result_that_says_less_is_recorded_with_less(chair_run: ChairRun, tmp_path: Path) -> None:
    """The preset paper judges no other poses and gives no probability; the axis and the box are not known."""
    rows = rows_of(write_recording(replace(chair_run.result, surroundings=None), tmp_path / "chair.rrd"))
    assert {"/scene/object", "/scene/samples", "/residual/scene", "/verdict"} <= set(rows)
    assert not {"/scene", "/scene/detection", "/scene/surroundings", "/scene/considered/0"} & set(rows)
    assert len(rows["/scene/object"]) == len(chair_run.result.trace) + 2
    assert "Probability" not in rows["/verdict"][0]["TextDocument:text"][0]


def test_a_recording_of_the_callers_own_goes_on(found: regnf.Registered, tmp_path: Path) -> None:
    with rr.RecordingStream("mine") as mine:
        memory = mine.memory_recording()
        found.save_recording(tmp_path / "chair.rrd")
        mine.log("mine", rr.TextLog("still here"), static=True)
        (tmp_path / "mine.rrd").write_bytes(memory.drain_as_bytes())
    assert {"/mine"} == set(rows_of(tmp_path / "mine.rrd")) - {"/__properties"}
    assert rr.get_global_data_recording() is None


def test_what_cannot_be_recorded_is_refused(
    found: regnf.Registered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder.rrd").mkdir()
    for name, reason in (("chair.bin", "INVALID_OPTIONS"), ("folder.rrd", "FILE_IS_FOLDER")):
        with pytest.raises(regnf.RegnfError) as refused:
            found.save_recording(tmp_path / name)
        assert refused.value.reason == reason
    with pytest.raises(regnf.RegnfError) as refused:
        replace(found, residuals={}).save_recording(tmp_path / "chair.rrd")
    assert refused.value.reason == "NO_CLOUDS"
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(regnf.RegnfError) as refused:
        found.save_recording(tmp_path / "chair.rrd")
    assert refused.value.reason == "RECORDING_DISABLED"
    assert [path.name for path in tmp_path.iterdir()] == ["folder.rrd"]


def test_a_full_disk_leaves_what_was_there(
    found: regnf.Registered, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "chair.rrd").write_bytes(b"of before")

    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:100])
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match="No space left"):
            found.save_recording(tmp_path / "chair.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["chair.rrd"]
    assert (tmp_path / "chair.rrd").read_bytes() == b"of before"


ALONE = """
import pickle, sys, psutil
from pathlib import Path
result = pickle.loads(Path(sys.argv[1]).read_bytes())
assert "rerun" not in sys.modules
before = psutil.Process().net_connections("inet")
result.save_recording(sys.argv[2])
assert "rerun" in sys.modules
assert psutil.Process().net_connections("inet") == before, psutil.Process().net_connections("inet")
assert psutil.Process().children() == []
"""


def test_recording_loads_rerun_late_starts_nothing_and_connects_to_nothing(
    found: regnf.Registered, tmp_path: Path
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "result").write_bytes(pickle.dumps(found))
    environment = {"HOME": str(home), "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(filter(None, sys.path))}
    command = [sys.executable, "-c", ALONE, str(tmp_path / "result"), str(tmp_path / "chair.rrd")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "chair.rrd").stat().st_size > 10_000
    assert not [path for path in home.rglob("*") if "rerun" in path.name.lower() or "analytics" in path.name.lower()]
