"""What holds for every kind of field: its name tells it, and unit and sign are applied round it."""

from __future__ import annotations

import subprocess
import sys
from typing import Any, get_args, get_type_hints

import numpy as np
import torch

from regnf_core.fields.build import build_field
from regnf_core.fields.observation import SdfField
from regnf_core.schema.kinds import KINDS
from regnf_core.schema.safe_format import description_to_dict, parse_description
from tests.core.fields.small_field import description, tensors
from tests.core.importing.archives import assert_refused


def small_field(**changes: Any) -> SdfField:
    parameters = {name: torch.from_numpy(array) for name, array in tensors().items()}
    return build_field(parse_description(description(**changes)), parameters)


def test_entries_that_all_kinds_share_have_defaults() -> None:
    parsed = parse_description(description())
    assert (parsed.world_scale, parsed.sign, parsed.up_axis) == (1.0, 1, None)
    assert parse_description(description_to_dict(parsed)) == parsed


def test_faulty_shared_entries() -> None:
    for kind in (None, 3, ["neus_facto"], "neus-facto", {}):
        assert_refused(lambda kind=kind: parse_description(description(kind=kind)), "FIELD_KIND_UNKNOWN")
    for name, value in (
        ("sign", 0),
        ("sign", 2),
        ("world_scale", 0.0),
        ("world_scale", float("nan")),
        ("up_axis", "w"),
    ):
        faulty = description(**{name: value})
        assert_refused(lambda faulty=faulty: parse_description(faulty), "SAFE_FORMAT_INVALID")


def test_coordinates_and_distances_scale_together() -> None:
    plain = small_field()
    scaled = small_field(world_scale=2.5, sign=-1, bounds=[[-2.5, -2.5, -2.5], [2.5, 2.5, 2.5]])
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    distance, gradient = scaled.signed_distance_and_gradient(2.5 * points)
    expected, slope = plain.signed_distance_and_gradient(points)
    torch.testing.assert_close(distance, -2.5 * expected)
    torch.testing.assert_close(gradient, -slope)
    torch.testing.assert_close(scaled.signed_distance(2.5 * points), distance, rtol=0, atol=1e-5)
    np.testing.assert_allclose(scaled.bounds.numpy(), [[-2.5] * 3, [2.5] * 3], rtol=1e-15)
    assert isinstance(scaled, SdfField)
    moved = scaled.to("cpu")
    torch.testing.assert_close(moved.signed_distance(points), scaled.signed_distance(points))
    assert moved.bounds.equal(scaled.bounds)


def test_the_gradient_is_that_of_the_scaled_distance() -> None:
    field = small_field(world_scale=0.01, bounds=[[-0.01] * 3, [0.01] * 3])
    points = 0.005 * torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step = 1e-5
    _, gradient = field.signed_distance_and_gradient(points)
    for axis in range(3):
        aside = torch.zeros(3, dtype=torch.float64)
        aside[axis] = step
        slope = (field.signed_distance(points + aside) - field.signed_distance(points - aside)) / (2 * step)
        torch.testing.assert_close(slope, gradient[:, axis], rtol=0, atol=0.05 * float(gradient.abs().max()))


def test_every_kind_is_described_without_torch() -> None:
    assert all(get_args(get_type_hints(kind)["kind"]) == (name,) for name, kind in KINDS.items())
    program = "import sys, regnf_core.schema.kinds; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
