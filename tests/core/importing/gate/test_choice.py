"""Of several functions that fit the shapes, the one whose gradient at the surface is a distance's is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field
from regnf_core.importing.families.converted import AmbiguousError, ConvertedField, converted_of
from regnf_core.importing.families.grid_search import grid_readings
from regnf_core.importing.gate.choice import settled
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import parse_description
from tests.core.importing.grids import Array, ball_table, passing_network

VALUES = {"levels": 5, "features_per_level": 1, "log2_table_size": 16, "base_resolution": 16}
EXACT = HashGridConfig.from_top_resolution(64, **VALUES, interpolation="linear")
USUAL = EXACT.with_entry_count(EXACT.entries + 35_944 - 32_768)
"""Growth sqrt 2 from 16: level 2 has 32 nodes, or 33 where exp2 erred upwards, as it did for this table."""
(OTHER,) = USUAL.stride_variants()
COARSE, FINE = (
    HashGridConfig.from_top_resolution(top, **VALUES | {"log2_table_size": 12}, interpolation="linear")
    for top in (64, 96)
)
"""Level 0 is dense, all others are hashed: tables of one size."""


def converted(table: Array, *grids: HashGridConfig) -> ConvertedField:
    layers = {
        f"layers.{i}.{part}": array
        for i, pair in enumerate(passing_network(3 + 5))
        for part, array in zip(("weight", "bias"), pair, strict=True)
    }
    entries = {"bounds": [[-1.0] * 3, [1.0] * 3], "grid_radius": 1.0}
    return converted_of("somebody's", ("keys",), grid_readings(table, grids, layers, entries))


@pytest.mark.parametrize("truth", [USUAL, OTHER], ids=["as laid out", "otherwise"])
def test_the_stride_it_was_trained_with_is_found(truth: HashGridConfig) -> None:
    assert (USUAL.level_strides()[2], OTHER.level_strides()[2]) == (33, 32)
    assert USUAL.level_entries() == OTHER.level_entries()
    chosen = settled(converted(ball_table(truth, 2), USUAL, OTHER))
    assert chosen.description["hash"]["strides"] == truth.strides
    assert settled(converted(ball_table(truth, 2), OTHER, USUAL)).description == chosen.description
    assert chosen.warnings == ()
    assert chosen.readings == ()
    assert "2 layouts" in chosen.why[-1]
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    points = points[points.norm(dim=-1) > 0.3]  # nearer to the center cells of 0.065 do not follow the distance
    tensors = {name: torch.from_numpy(array) for name, array in chosen.tensors.items()}
    distance = build_field(parse_description(chosen.description), tensors).signed_distance(points)
    torch.testing.assert_close(distance, points.norm(dim=-1) - 0.5, rtol=0, atol=5e-3)


def test_layouts_that_are_one_function_are_not_asked_about() -> None:
    """Only level 0 has anything in it, and that is the same in both."""
    chosen = settled(converted(ball_table(COARSE, 0), FINE, COARSE))
    assert chosen.description["hash"]["per_level_scale"] == FINE.per_level_scale
    assert "all give the same function" in chosen.why[-1]


def test_layouts_that_differ_and_fit_alike_are_asked_about() -> None:
    """A table of noise fits no layout better than another."""
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, FINE.entries).astype(np.float32)
    with pytest.raises(FieldFormatError) as caught:
        settled(converted(noise, FINE, COARSE))
    assert caught.value.reason == "LAYOUT_AMBIGUOUS"


def test_where_none_has_a_surface_the_most_usual_one_stays_and_plausibility_decides() -> None:
    chosen = settled(converted(ball_table(USUAL, 2, radius=-1.0), USUAL, OTHER))
    assert chosen.description["hash"]["strides"] is None
    plain = converted(ball_table(USUAL, 2), USUAL)
    assert settled(plain) is plain, "without doubt nothing is tried"


def test_whoever_is_asked_for_the_interpolation_says_the_layout_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """What cannot tell the interpolation does not prove the layout either: an answer must not confirm it unread."""
    monkeypatch.setattr("regnf_core.importing.gate.choice.told_interpolation", lambda linear, smooth: None)
    found = converted(ball_table(USUAL, 2), USUAL, OTHER)
    said = {"levels": 5, "base_resolution": 16}
    readings = tuple(replace(one, interpolation="open", say={"hash": said}) for one in found.readings)
    with pytest.raises(AmbiguousError) as caught:
        settled(replace(found, readings=readings))
    asked = [candidate.say for candidate in caught.value.asked]
    assert asked == [{"hash": {**said, "interpolation": kind}} for kind in ("linear", "smoothstep")]
    assert '"levels": 5' in str(caught.value)
