"""Settings of no trainer in particular, and settings that nobody knows."""

from __future__ import annotations

import pytest

from tests.core.importing.archives import assert_refused
from tests.core.importing.settings.translating import translated


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("model: {omega_0: 30}", {"activation_scale": 30.0}),
        (
            "network: {first_omega_0: 60, hidden_omega_0: 30}",
            {"first_activation_scale": 60.0, "activation_scale": 30.0},
        ),
        ("integrate: {voxel_size: 0.01, trunc_voxel_multiplier: 8}", {"truncation": 0.08}),
        ("sdf_trunc: 0.04", {"truncation": 0.04}),
    ],
)
def test_settings_of_no_trainer_in_particular(text: str, values: dict[str, float]) -> None:
    assert translated({"config.yaml": text}).values == values


def test_settings_that_nobody_knows() -> None:
    assert_refused(lambda: translated({"config.yaml": "a: 1"}), "SETTINGS_NOT_RECOGNIZED")
    found = translated({"config.yaml": "a: 1"}, required=False)
    assert (found.values, found.report()) == ({}, None)
    assert found.warnings[0].startswith("SETTINGS_NOT_USED: ")
