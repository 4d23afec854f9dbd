"""The axis that a registration's picture stands on."""

from __future__ import annotations

from dataclasses import replace

import pytest

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
    class SeenError(Exception):
        """Raised with the axis that the picture is to stand on, before it is drawn."""

    def view_from(direction: object, axis: object, points: object, edge: int) -> None:
        raise SeenError(axis)

    monkeypatch.setattr(module, "view_from", view_from)
    with pytest.raises(SeenError) as seen:
        module.registration_picture(replace(chair_run.result, options=RegistrationOptions.from_dict(options).to_dict()))
    assert seen.value.args[0].tolist() == up
