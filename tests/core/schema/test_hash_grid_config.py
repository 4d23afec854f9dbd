"""The layout of the grid: totals known from published checkpoints, and the rounding of doubtful levels."""

from __future__ import annotations

import pytest

from regnf_core.schema.hash_grid_config import HashGridConfig
from tests.core.importing.archives import assert_refused


@pytest.mark.parametrize(
    ("top", "values", "parameters"),
    [
        (2048, {}, 12_196_240),  # neus-facto
        (4096, {"base_resolution": 64, "log2_table_size": 22, "features_per_level": 8}, 446_837_120),
        (2048, {"base_resolution": 32, "log2_table_size": 22, "features_per_level": 8}, 365_792_384),  # Neuralangelo
        (2048, {"base_resolution": 32}, 13_969_152),  # instant-nsr-pl
    ],
)
def test_whole_table_has_the_published_size(top: int, values: dict[str, int], parameters: int) -> None:
    config = HashGridConfig.from_top_resolution(top, **values)
    assert (
        config.with_entry_count(parameters // config.features_per_level).entries * config.features_per_level
        == parameters
    )


def test_small_levels_by_hand() -> None:
    # Growth 1.5 from 4: scales 3, 5, 8 -> 4, 6 and 9 nodes an edge: 64, 216 and 729 nodes; 256 fit.
    config = HashGridConfig(levels=3, features_per_level=1, log2_table_size=8, base_resolution=4, per_level_scale=1.5)
    assert config.scales() == (3.0, 5.0, 8.0)
    assert config.level_resolutions() == (4, 6, 9)
    assert config.level_entries() == (64, 216, 256)
    assert config.level_is_dense() == (True, True, False)
    assert config.width == 3


def test_a_table_settles_how_a_whole_number_was_rounded() -> None:
    # 16 -> 512 over 16 levels doubles every third level: exact arithmetic gives 32 and 64 nodes at levels 3 and 6, an
    # exp2 that errs upwards gives 33 and 65.
    config = HashGridConfig.from_top_resolution(512)
    exact, above = 5_246_024, 5_246_024 + (35_944 - 32_768) + (274_632 - 262_144)
    for entries, expected in ((exact, (32, 64)), (above, (33, 65))):
        settled = config.with_entry_count(entries)
        assert settled.entries == entries
        assert (settled.level_resolutions()[3], settled.level_resolutions()[6]) == expected


def test_a_table_of_no_possible_size_is_refused() -> None:
    assert_refused(lambda: HashGridConfig.from_top_resolution(512).with_entry_count(5_246_025), "FIELD_SHAPES_MISMATCH")


@pytest.mark.parametrize("name", ["resolutions", "strides"])
def test_one_resolution_a_level(name: str) -> None:
    assert_refused(lambda: HashGridConfig(levels=3, **{name: (16, 20)}), "FIELD_SHAPES_MISMATCH")


def test_only_dense_levels_with_room_are_indexed_otherwise() -> None:
    """16 -> 512 doubles every third level. A table laid out for 33 and 65 nodes holds 32 and 64; not the other way."""
    config = HashGridConfig.from_top_resolution(512)
    exact = config.with_entry_count(5_246_024)
    assert list(exact.stride_variants()) == []
    above = config.with_entry_count(5_246_024 + (35_944 - 32_768) + (274_632 - 262_144))
    levels = [(variant.level_strides()[3], variant.level_strides()[6]) for variant in above.stride_variants()]
    assert levels == [(32, 65), (33, 64), (32, 64)]
    assert {variant.entries for variant in above.stride_variants()} == {above.entries}
