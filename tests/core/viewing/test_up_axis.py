"""The axis that a registration's picture stands on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from regnf_core.document import CameraView, RegistrationResult
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.viewing import registration_picture as module
from tests.core.conftest import ChairRun


@pytest.mark.parametrize(
    ("options", "up"),
    [({}, [0, 0, 1]), ({"up_axis": "y"}, [0, 1, 0]), ({"preset": "paper", "up_axis": "x"}, [1, 0, 0])],
)
def test_the_picture_stands_on_the_axis_that_the_options_name(
    options: dict[str, object], up: list[int], chair_run: ChairRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = replace(chair_run.result, options=RegistrationOptions.from_dict(options).to_dict())
    assert seen_from(result, monkeypatch)[1].tolist() == up


def test_of_a_detection_in_an_image_the_picture_shows_what_its_camera_sees(
    chair_run: ChairRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that stands at (0, -4, 1) and looks along y: its x is the scene's, its y points down."""
    matrix = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -4.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    result = replace(chair_run.result, camera=CameraView("0", Sim3.from_matrix(matrix)))
    direction, up = seen_from(result, monkeypatch)
    assert up.tolist() == [0.0, 0.0, 1.0]
    np.testing.assert_allclose(direction, [0.0, -4.0, 1.0] - result.scene_samples.points.double().mean(0).numpy())


def seen_from(result: RegistrationResult, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    """The direction to the viewer and the axis that is up, before anything is drawn."""

    class SeenError(Exception):
        """Raised with both."""

    def view_from(direction: object, axis: object, points: object, edge: int) -> None:
        raise SeenError(direction, axis)

    monkeypatch.setattr(module, "view_from", view_from)
    with pytest.raises(SeenError) as seen:
        module.registration_picture(result)
    return seen.value.args[0], seen.value.args[1]
