from __future__ import annotations

from typing import Any

import pytest

from regnf_core.importing.families.grid_search import MAX_GRIDS, GridHabits, find_grids, grid_name
from regnf_core.importing.upload_description import GridDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from tests.core.importing.archives import assert_refused

HABITS = GridHabits((2, 4, 8), ((16, 2048), (16, 512), (64, 4096)), "smoothstep")


def find(parameters: int, width: int, **overrides: Any) -> tuple[HashGridConfig, ...]:
    return find_grids(parameters, width, HABITS, GridDescription(**overrides))


def only(parameters: int, width: int, **overrides: Any) -> HashGridConfig:
    (config,) = find(parameters, width, **overrides)
    return config


def test_the_published_sizes_are_recognized() -> None:
    """12 196 240 and 446 837 120 are what tiny-cuda-nn reports for neus-facto's and angelo's grids."""
    facto = only(12_196_240, 32)
    assert (facto.levels, facto.features_per_level, facto.log2_table_size) == (16, 2, 19)
    assert facto.per_level_scale == pytest.approx(1.3819128799677762, abs=1e-15)
    angelo = only(446_837_120, 128)
    assert (angelo.levels, angelo.features_per_level, angelo.log2_table_size) == (16, 8, 22)
    assert angelo.base_resolution == 64


@pytest.mark.parametrize("log2_size", range(14, 23))
def test_every_usual_table_size_is_told_by_its_total(log2_size: int) -> None:
    """Totals by hand: the dense lattices of neus-facto's resolutions, rounded up to eights, capped at 2^T."""
    resolutions = [16, 23, 31, 43, 59, 81, 112, 154, 213, 295, 407, 562, 777, 1073, 1483, 2048]
    entries = sum(min((r**3 + 7) // 8 * 8, 2**log2_size) for r in resolutions)
    assert only(2 * entries, 32).log2_table_size == log2_size


def test_another_machines_rounding_is_settled_by_the_total() -> None:
    """base 16, top 512: the resolutions double every third level, where exp2f decides between 32 and 33, 64 and 65."""
    others = [r**3 for r in (16, 21, 26, 41, 51)]
    exact, bumped = [32**3, 64**3], [33**3, 65**3]
    hashed = 9 * 2**19
    for doubtful, expected in ((exact, (32, 64)), (bumped, (33, 65)), ([32**3, 65**3], (32, 65))):
        entries = sum((nodes + 7) // 8 * 8 for nodes in others + doubtful) + hashed
        resolutions = find(2 * entries, 32, top_resolution=512)[0].level_resolutions()
        assert (resolutions[3], resolutions[6]) == expected


def test_the_training_device_may_have_indexed_a_level_otherwise() -> None:
    """Neuralangelo's grid: level 5 has 129 nodes an edge by the table's length, its rows may be 128 apart."""
    habits = GridHabits((8,), ((32, 2048),), "linear")
    usual, other = find_grids(365_792_384, 128, habits, GridDescription())
    assert usual.level_strides()[5] == usual.level_resolutions()[5] == 129
    assert (other.level_strides()[5], other.level_resolutions()[5]) == (128, 129)
    assert other.entries == usual.entries
    assert "indexed level 5 by 128" in grid_name(other)


def test_a_table_that_fits_several_grids_gives_them_all_the_most_usual_first() -> None:
    found = find(16 * 4096 * 2, 32)
    assert 1 < len(found) <= MAX_GRIDS
    assert len(set(found)) == len(found)
    assert (found[0].features_per_level, found[0].base_resolution, found[0].level_resolutions()[-1]) == (2, 16, 2048)


def test_the_description_narrows_the_search() -> None:
    found = only(16 * 4096 * 2, 32, base_resolution=16, top_resolution=512, features_per_level=2)
    assert found.scales()[-1] == pytest.approx(511, abs=0.01)
    assert only(12_196_240, 32, interpolation="linear").interpolation == "linear"


def test_no_usual_grid_is_a_refusal() -> None:
    assert_refused(lambda: find(12_196_241, 32), "HASH_GRID_NOT_RECOGNIZED")
    assert_refused(lambda: find(12_196_240, 33), "HASH_GRID_NOT_RECOGNIZED")
    assert_refused(lambda: find(2, 1_000_000), "HASH_GRID_NOT_RECOGNIZED")


def test_levels_that_grow_faster_than_a_field_file_may_say_are_not_tried() -> None:
    """Two levels from 16 to 512 nodes would grow by 32; eight of them by 32^(1/7)."""
    grid = HashGridConfig.from_top_resolution(512, levels=8, features_per_level=2, log2_table_size=12)
    found = find(grid.entries * 2, 16)
    assert grid in [config for config in found if config.strides is None]
    assert all(config.per_level_scale <= 8.0 for config in found)
