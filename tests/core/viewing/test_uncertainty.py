"""The uncertainty of where an object's center is, against perturbed poses, and wherever the scene's origin is."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from regnf_core import RegistrationResult, register
from regnf_core.fields.composite import TransformedField
from regnf_core.geometry.metrics import center_covariance, uncertainty
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.verdict.covariance import in_object_units
from regnf_core.robust.working_frame import WorkingFrame
from tests.core.analytic import chair, chair_box, chair_pose, room

POSE = Sim3.from_quaternion(1.6, [0.1, -0.4, 0.2, 0.9], [3.0, -5.0, 2.0])
CENTER = torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)


def some_covariance(size: float) -> Tensor:
    half = size * torch.randn(7, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return half @ half.mT


def places(T: Sim3, steps: Tensor) -> Tensor:
    """(N, 3): where perturbed poses put the center, scene frame."""
    return T.expand(len(steps)).perturb(steps).inverse().apply(CENTER.expand(len(steps), 1, 3))[:, 0]


def test_against_finite_differences() -> None:
    step = 1e-6
    eye = torch.eye(7, dtype=torch.float64)
    J = ((places(POSE, step * eye) - places(POSE, -step * eye)) / (2 * step)).mT
    covariance = some_covariance(0.1)
    torch.testing.assert_close(
        center_covariance(covariance, POSE, CENTER), J @ covariance @ J.mT, rtol=1e-7, atol=1e-12
    )


@pytest.mark.parametrize("far", [7.0, 1000.0, 1e6])
def test_it_does_not_depend_on_where_the_scenes_origin_is(far: float) -> None:
    """The very pose and its covariance, told by a scene whose origin is that far away; 1e6: as maps of cities have."""
    shift = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * far
    obj = WorkingFrame(CENTER, 0.95)
    covariance = some_covariance(1e-3)

    def told(shift: Tensor) -> dict[str, list[float]]:
        scene = WorkingFrame(torch.tensor([0.4, -0.3, 0.2], dtype=torch.float64) + shift, 1.3)
        T = obj.to_field() @ POSE_IN_WORKING_FRAMES @ scene.to_field().inverse()
        return uncertainty(in_object_units(covariance, POSE_IN_WORKING_FRAMES, scene, obj), T, CENTER)

    here, there = told(torch.zeros(3, dtype=torch.float64)), told(shift)
    exact = (
        1e-9 if far <= 1000.0 else 1e-3
    )  # a (7, 7) about a far origin holds the center's variance in its last digits
    for name in ("center_scene", "rotation_deg"):
        assert there[name] == pytest.approx(here[name], rel=exact)


def test_the_contracts_example_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    """The code of docs/api.md, run, and the same numbers from the engine."""
    text = (Path(__file__).resolve().parents[3] / "docs" / "api.md").read_text(encoding="utf-8")
    code = text.split("### The covariance")[1].split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {}
    exec(code, names)
    told = re.findall(r"#.*?(\[[\d. ]+\])", code)
    assert capsys.readouterr().out.splitlines() == told
    T, center = Sim3.from_matrix(torch.tensor(names["T"]).double()), torch.tensor(names["center"]).double()
    found = uncertainty(torch.tensor(names["C"]), T, center)
    assert found["center_scene"] == pytest.approx([0.002] * 3)


POSE_IN_WORKING_FRAMES = Sim3.from_quaternion(1.3, [0.2, 0.1, -0.3, 0.9], [0.05, -0.1, 0.02])


def registered(far: float) -> RegistrationResult:
    """The chair in its room, which stands that far from the scene's origin; the search begins near by."""
    move = Sim3.from_translation(torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64) * far)
    T = chair_pose() @ move.inverse()
    start = Sim3.from_quaternion(1.0, [0.01, 0.0, 0.02, 1.0], [0.01, 0.0, -0.01]) @ T
    scene = TransformedField(room(chair_pose()), move.inverse())
    return register(scene, chair(), chair_box(T), initial_transform=start, clouds=False)


def test_a_registration_far_from_the_origin_is_as_certain() -> None:
    at_home, found = registered(0.0), registered(60.0)
    assert found.covariance is not None
    assert at_home.covariance is not None
    here, there = (uncertainty(one.covariance, one.T_object_scene, one.center_object) for one in (at_home, found))
    assert max(there["center_scene"]) <= 3 * max(here["center_scene"]) + 1e-4
    assert math.sqrt(float(found.covariance.diagonal()[3:6].max())) > max(there["center_scene"]), "of the vector alone"
