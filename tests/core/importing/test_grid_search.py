from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from regnf_core.importing.families.grid_search import GridHabits, find_spaces, grid_name
from regnf_core.importing.families.grid_space import WrittenGrid
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import MAX_GROWTH, HashGridConfig
from tests.core.importing.archives import assert_refused

HABITS = GridHabits((2, 4, 8), "smoothstep")


def find(parameters: int, width: int, **overrides: Any) -> list[WrittenGrid]:
    spaces = find_spaces(parameters, width, HABITS, GridDescription(**overrides))
    return sorted((entry for space in spaces for entry in space.written), key=lambda entry: entry.tier)


def most_usual(parameters: int, width: int, **overrides: Any) -> HashGridConfig:
    """The only grid of the lowest tier."""
    (config,) = (entry.grid for entry in find(parameters, width, **overrides) if entry.tier == 0)
    return config


def test_the_published_sizes_are_recognized() -> None:
    """12 196 240 and 446 837 120 are what tiny-cuda-nn reports for neus-facto's and angelo's grids."""
    facto = most_usual(12_196_240, 32)
    assert (facto.levels, facto.features_per_level, facto.log2_table_size) == (16, 2, 19)
    assert facto.per_level_scale == pytest.approx(1.3819128799677762, abs=1e-15)
    angelo = most_usual(446_837_120, 128)
    assert (angelo.levels, angelo.features_per_level, angelo.log2_table_size) == (16, 8, 22)
    assert angelo.base_resolution == 64


@pytest.mark.parametrize("log2_size", range(14, 23))
def test_every_usual_table_size_is_told_by_its_total(log2_size: int) -> None:
    """Totals by hand: the dense lattices of neus-facto's resolutions, rounded up to eights, capped at 2^T."""
    resolutions = [16, 23, 31, 43, 59, 81, 112, 154, 213, 295, 407, 562, 777, 1073, 1483, 2048]
    entries = sum(min((r**3 + 7) // 8 * 8, 2**log2_size) for r in resolutions)
    found = [entry.grid for entry in find(2 * entries, 32) if entry.tier == 0]
    assert log2_size in [grid.log2_table_size for grid in found if grid.level_resolutions()[:5] == (16, 23, 31, 43, 59)]


def test_another_machines_rounding_is_settled_by_the_total() -> None:
    """base 16, top 512: the resolutions double every third level, where exp2f decides between 32 and 33, 64 and 65."""
    others = [r**3 for r in (16, 21, 26, 41, 51)]
    exact, bumped = [32**3, 64**3], [33**3, 65**3]
    hashed = 9 * 2**19
    for doubtful, expected in ((exact, (32, 64)), (bumped, (33, 65)), ([32**3, 65**3], (32, 65))):
        entries = sum((nodes + 7) // 8 * 8 for nodes in others + doubtful) + hashed
        for said in ({}, {"top_resolution": 512}):
            grid = most_usual(2 * entries, 32, **said)
            resolutions = grid.level_resolutions()
            assert (resolutions[3], resolutions[6]) == expected
            assert grid.per_level_scale == pytest.approx(2 ** (1 / 3), rel=1e-6)


@pytest.mark.parametrize("seed", range(40))
def test_every_random_grid_is_among_those_found(seed: int) -> None:
    """Whatever the settings: levels 4 to 20, tables of 2^10 to 2^19, any base, any finest resolution."""
    random = np.random.default_rng(seed)
    levels, size = int(random.integers(4, 21)), int(random.integers(10, 20))
    base, features = int(random.integers(4, 65)), int(random.choice([1, 2, 4, 8]))
    growth = min(float(random.uniform(1.1, 2.0)), (4096 / base) ** (1 / (levels - 1)))
    grid = HashGridConfig(levels, features, size, base, growth)
    spaces = find_spaces(grid.entries * features, grid.width, HABITS, GridDescription())
    assert any(
        space.features_per_level == features
        and interval.levels == levels
        and (interval.base_resolution == base or (interval.base_is_free and interval.base_resolution <= base))
        and interval.lowest <= float(np.float32(growth)) <= interval.highest
        for space in spaces
        for interval in space.intervals
    )


def test_every_grid_that_is_found_has_the_tables_size() -> None:
    for parameters in (12_196_240, 2 * 4096 * 16, 2**20):
        found = find(parameters, 32)
        assert found
        for entry in found:
            assert entry.grid.entries * entry.grid.features_per_level == parameters


def test_a_table_of_full_levels_leaves_base_and_growth_open() -> None:
    found = find(16 * 4096 * 2, 32)
    tiers = [entry.tier for entry in found]
    assert tiers == sorted(tiers)
    assert {entry.grid.base_resolution for entry in found if entry.tier == 0} == {16, 32, 64, 128}


def test_what_the_description_says_is_taken_as_it_is() -> None:
    said = {"levels": 16, "features_per_level": 2, "log2_table_size": 12, "base_resolution": 16}
    (top,) = find(16 * 4096 * 2, 32, **said, top_resolution=500)
    assert top.grid.scales()[-1] == pytest.approx(499, abs=0.01)
    (growth,) = find(16 * 4096 * 2, 32, **said, per_level_scale=1.26)
    assert growth.grid.per_level_scale == 1.26
    assert most_usual(12_196_240, 32, interpolation="linear").interpolation == "linear"


@pytest.mark.parametrize(
    "said",
    [
        {"levels": 8, "features_per_level": 2},
        {"levels": 8},
        {"log2_table_size": 18},
        {"base_resolution": 17},
        {"base_resolution": 16, "top_resolution": 1024},
        {"per_level_scale": 1.5},
    ],
)
def test_what_the_tensors_exclude_is_refused(said: dict[str, Any]) -> None:
    assert_refused(lambda: find(12_196_240, 32, **said), "SETTINGS_CONTRADICT_TENSORS")


def test_no_grid_at_all_is_a_refusal() -> None:
    assert_refused(lambda: find(12_196_241, 32), "HASH_GRID_NOT_RECOGNIZED")
    assert_refused(lambda: find(12_196_240, 33), "HASH_GRID_NOT_RECOGNIZED")
    assert_refused(lambda: find(2, 1_000_000), "HASH_GRID_NOT_RECOGNIZED")


def test_the_training_device_may_have_indexed_a_level_otherwise() -> None:
    """Neuralangelo's grid: level 5 has 129 nodes an edge by the table's length, its rows may be 128 apart."""
    usual = most_usual(365_792_384, 128)
    assert usual.level_strides()[5] == usual.level_resolutions()[5] == 129
    (other,) = usual.stride_variants()
    assert (other.level_strides()[5], other.level_resolutions()[5]) == (128, 129)
    assert other.entries == usual.entries
    assert "indexed level 5 by 128" in grid_name(other)
    assert "indexed" not in grid_name(usual)


def test_levels_that_grow_faster_than_a_field_file_may_say_are_not_found() -> None:
    """Two levels from 16 to 512 nodes would grow by 32; eight of them by 32^(1/7)."""
    grid = HashGridConfig.from_top_resolution(512, levels=8, features_per_level=2, log2_table_size=12)
    found = [entry.grid for entry in find(grid.entries * 2, 16)]
    assert grid in found
    assert all(config.per_level_scale <= MAX_GROWTH for config in found)
