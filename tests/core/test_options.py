"""Options: what is refused, and what the refusal suggests."""

from __future__ import annotations

from typing import Any

import pytest

from regnf_core.cost import BASE_BYTES, estimate, ray_count
from regnf_core.errors import InvalidOptionsError
from regnf_core.options import Preset, RegistrationOptions
from tests.option_extremes import extremes, numeric_options


@pytest.mark.parametrize(
    ("values", "meant"),
    [
        ({"robust": {"up_axis": "z"}}, "up_axis"),
        ({"sampling": {"up_axis": "y"}}, "up_axis"),
        ({"initialisation": {"draws": 3}}, "initialization"),
        ({"optimization": {"regulariser_weight": 0.5}}, "optimization.regularizer_weight"),
        ({"robust": {"rotation": 300}}, "robust.rotations"),
        ({"rotations": 300}, "robust.rotations"),
        ({"upaxis": "z"}, "up_axis"),
    ],
)
def test_an_unknown_option_is_refused_with_the_name_that_was_meant(values: dict[str, Any], meant: str) -> None:
    with pytest.raises(InvalidOptionsError, match=f"did you mean `{meant}`\\?"):
        RegistrationOptions.from_dict(values)


def test_a_limit_of_a_share_is_refused_with_what_decides_now() -> None:
    with pytest.raises(InvalidOptionsError, match=r"only the probability decides: see `robust\.acceptance`"):
        RegistrationOptions.from_dict({"robust": {"min_inlier_share": 0.5}})


def test_a_name_like_none_gets_no_suggestion() -> None:
    with pytest.raises(InvalidOptionsError) as raised:
        RegistrationOptions.from_dict({"qqqqqq": 1})
    assert "did you mean" not in str(raised.value)
    assert str(raised.value).startswith("options.qqqqqq: ")


def test_there_is_one_up_axis() -> None:
    given = RegistrationOptions.from_dict({"up_axis": "y"}).to_dict()
    assert given["up_axis"] == "y"
    assert [name for name, group in given.items() if isinstance(group, dict) and "up_axis" in group] == []


# What options are estimated to cost, and that no product of options goes unnoticed.


GIB = 1 << 30


def paper(**groups: dict[str, int]) -> RegistrationOptions:
    return RegistrationOptions.from_dict({"preset": "paper", **groups})


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_default_options_are_cheap(preset: Preset) -> None:
    cost = estimate(RegistrationOptions(preset=preset))
    assert cost.memory_bytes < GIB
    assert cost.seconds < 60


def test_a_small_request_for_many_rays_is_estimated_at_what_it_would_take() -> None:
    options = paper(sampling={"views": 64, "image_size": 4096, "pixel_stride": 1})
    cost = estimate(options)
    assert ray_count(options) == 2**30
    assert cost.memory_bytes > 100 * GIB
    assert cost.largest("memory_bytes").counts == "rays"
    assert cost.largest("memory_bytes").count == 2**30


def test_rays_are_counted_as_they_are_cast() -> None:
    assert ray_count(paper(sampling={"views": 3, "image_size": 100, "pixel_stride": 30})) == 27
    assert ray_count(paper(sampling={"views": 3, "image_size": 8, "pixel_stride": 512})) == 3


def test_options_of_the_other_preset_cost_nothing() -> None:
    many = {"sampling": {"views": 64, "image_size": 4096, "pixel_stride": 1}}
    assert estimate(RegistrationOptions.from_dict(many)) == estimate(RegistrationOptions())


def test_a_search_among_many_objects_costs_more_than_one_registration() -> None:
    options = RegistrationOptions()
    assert estimate(options, objects=100).seconds > 20 * estimate(options).seconds
    assert estimate(options, objects=100).memory_bytes > estimate(options).memory_bytes > BASE_BYTES


@pytest.mark.parametrize("name", [one.name for one in numeric_options()])
def test_every_option_that_makes_work_makes_cost(name: tuple[str, str]) -> None:
    """A new option must be looked at: either it is part of a term, or it is listed here as one that makes no work."""
    preset: Preset = "robust" if name[0] == "robust" else "paper"
    found = {term_option for term in estimate(RegistrationOptions(preset=preset)).terms for term_option in term.options}
    without_work = {
        ("sampling", "scene_camera_distance"), ("sampling", "object_camera_distance"), ("sampling", "ground_fraction"),
        ("initialization", "voxel_size"), ("initialization", "ransac_distance_voxels"),
        ("initialization", "edge_length_ratio"), ("initialization", "icp_distance_voxels"),
        ("optimization", "translation_rate"), ("optimization", "rotation_rate"), ("optimization", "scale_rate"),
        ("optimization", "kernel_rate"), ("optimization", "regularizer_weight"), ("optimization", "stop_residual"),
        ("resampling", "own_distance"), ("resampling", "other_distance"), ("resampling", "residual"),
        ("resampling", "radius_fraction"), ("robust", "held_out_share"), ("robust", "inlier_distance"),
        ("robust", "rival_margin"), ("robust", "box_tolerance"), ("robust", "min_probability"),
    }  # fmt: skip
    assert (name in found) != (name in without_work)


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_the_extremes_of_single_options_and_of_pairs_are_options(preset: Preset) -> None:
    made = list(extremes(preset))
    assert len(made) > 100
    for _, values in made:
        RegistrationOptions.from_dict(values)
