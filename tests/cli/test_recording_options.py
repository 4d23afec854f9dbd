"""What is said of a recording at the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from regnf_cli.options import given_of
from regnf_core.errors import DatasetError, InvalidOptionsError
from regnf_data.recordings.opening import open_recording
from tests.data.recordings import writers
from tests.data.recordings.truth import K, walk


@pytest.mark.parametrize(
    ("said", "step"), [("mm", 0.001), ("m", 1.0), ("0.0002", 0.0002), ("5000", 0.0002), ("1", 0.001), ("0.1", 0.0001)]
)
def test_units_of_depth(said: str, step: float) -> None:
    assert given_of(depth_unit=said).depth_unit == pytest.approx(step)


@pytest.mark.parametrize("said", ["feet", "nan", "0", "-1", "inf", ""])
def test_what_is_no_unit_is_refused(said: str) -> None:
    with pytest.raises(InvalidOptionsError, match="--depth-unit"):
        given_of(depth_unit=said)


def test_intrinsics_are_a_file_or_numbers(tmp_path: Path) -> None:
    path = tmp_path / "K.txt"
    np.savetxt(path, K)
    written = given_of(intrinsics=str(path)).camera
    typed = given_of(intrinsics=f"{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]},80,60").camera
    assert written is not None
    assert typed is not None
    assert np.allclose(written.K, typed.K)
    assert typed.size == (60, 80)


@pytest.mark.parametrize("said", ["nothing.json", "1,2,3", "500,500,nan,240", "0,500,320,240"])
def test_what_are_no_intrinsics_is_refused(said: str) -> None:
    with pytest.raises((InvalidOptionsError, DatasetError), match="--intrinsics"):
        given_of(intrinsics=said)


@pytest.mark.parametrize("axes", ["opencv", "opengl", None])
def test_cameras_look_where_it_is_said(axes: str | None, tmp_path: Path) -> None:
    truth = walk(2)
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    for writer, own in ((writers.redwood, "opencv"), (writers.nerfstudio, "opengl")):
        folder = writer(tmp_path / f"{own}", truth)
        found = open_recording(folder, given_of(axes=axes)).frames[0].T_world_camera  # type: ignore[arg-type]
        assert np.allclose(found, truth.poses[0] @ (np.eye(4) if axes in (None, own) else opengl), atol=1e-5)
