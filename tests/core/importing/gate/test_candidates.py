"""What a person is asked when a file may be one of several functions: the entries, the pictures, and their bounds."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from regnf_core.errors import MOST_CANDIDATES, Candidate, FieldFormatError
from regnf_core.importing.families.converted import AmbiguousError, OpenCandidate, Reading
from regnf_core.importing.gate.convert import draw_asked
from regnf_core.importing.gate.gate import import_field, read_candidates
from regnf_core.importing.gate.picture import CANDIDATE_BYTES, candidate_name
from regnf_core.viewing.field_picture import SMALL
from tests.core.importing import small_families as small
from tests.core.importing.gate.test_picture import png

ONE = {"output_tanh": 1}


def two_scales(folder: Path) -> Path:
    """A network whose file does not say at which scale it was trained."""
    torch.save(small.neus().checkpoint, folder / "upload")
    return folder / "upload"


def reading(radius: float) -> Reading:
    """A ball on a grid of nodes."""
    axes = np.meshgrid(*[np.linspace(-1.0, 1.0, 24)] * 3, indexing="ij")
    values = (np.sqrt(sum(axis**2 for axis in axes)) - radius).astype(np.float32)
    entries: dict[str, Any] = {"bounds": [[-1.0] * 3, [1.0] * 3], "world_scale": 1.0, "sign": 1, "up_axis": None}
    entries |= {"label": None, "source": {}, "kind": "voxel_grid", "origin": [-1.0] * 3, "spacing": [2.0 / 23.0] * 3}
    return Reading(f"radius {radius}", entries, {"values": values})


def candidate(radius: float) -> OpenCandidate:
    return OpenCandidate(f"radius {radius}", ONE, lambda: reading(radius))


def test_a_file_of_several_functions_is_refused_with_each_of_them(tmp_path: Path) -> None:
    """Without pictures: test_instant_nsr_pl.py."""
    upload, out = two_scales(tmp_path), tmp_path / "out"
    with pytest.raises(FieldFormatError) as caught:
        import_field(upload, out, {"label": "pot"}, picture=True)
    assert caught.value.reason == "LAYOUT_AMBIGUOUS"
    assert list(out.iterdir()) == []
    asked = caught.value.candidates
    assert [one.description for one in asked] == [{"input_scale": 1.0}, {"input_scale": 3.0}]
    assert all(one.picture is not None for one in asked)


def test_each_is_drawn(tmp_path: Path) -> None:
    """One that has no surface has no picture, and keeps none from the others."""
    draw_asked([candidate(0.3), candidate(-1.0), candidate(0.8)], tmp_path, 1e6)
    assert {path.name for path in tmp_path.iterdir()} == {candidate_name(1), candidate_name(3)}
    orange = []
    for number in (1, 3):
        with Image.open(tmp_path / candidate_name(number)) as picture:
            assert picture.size == (3 * SMALL.panel, SMALL.panel)
            section = np.asarray(picture)[:, 2 * SMALL.panel :].astype(int)
        orange.append((section[..., 0] > section[..., 2] + 20).mean())
    assert orange[1] / orange[0] == pytest.approx((0.8 / 0.3) ** 2, rel=0.1)


def test_without_time_none_is_drawn(tmp_path: Path) -> None:
    draw_asked([candidate(0.3)], tmp_path, -1.0)
    assert list(tmp_path.iterdir()) == []


def test_noise_is_the_largest_picture(tmp_path: Path) -> None:
    """What no compression makes smaller stays below the bound all the same."""
    noise = np.random.default_rng(0).integers(0, 256, (SMALL.panel, 3 * SMALL.panel, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, "PNG")
    assert len(buffer.getvalue()) < CANDIDATE_BYTES


def test_candidates_that_say_the_same_or_nothing_are_not_asked_about() -> None:
    said = [{"output_tanh": 1}, {}, {"output_tanh": 1}, *({"output_column": column} for column in range(20))]
    error = AmbiguousError("which?", [OpenCandidate(f"{one}", one, lambda: reading(0.5)) for one in said])
    assert [one.say for one in error.asked] == [{"output_tanh": 1}, *({"output_column": n} for n in range(5))]


def test_a_candidate_adds_to_what_was_said() -> None:
    said = {"label": "chair", "hash": {"levels": 8, "top_resolution": 64}}
    whole = Candidate("finer", {"hash": {"top_resolution": 128}, "sign": -1}).added_to(said)
    assert whole == {"label": "chair", "hash": {"levels": 8, "top_resolution": 128}, "sign": -1}
    assert said["hash"] == {"levels": 8, "top_resolution": 64}


def test_what_the_child_says_is_checked(tmp_path: Path) -> None:
    (tmp_path / candidate_name(1)).write_bytes(png())
    (tmp_path / candidate_name(2)).symlink_to(tmp_path / candidate_name(1))
    (tmp_path / candidate_name(3)).write_bytes(b"<script>")
    name = "a\x1b[2Jb" + "c" * 1000
    values = [{"name": name, "description": ONE, "more": 1}] + [{"name": str(n), "description": ONE} for n in range(9)]
    found = read_candidates(values, tmp_path)
    assert len(found) == MOST_CANDIDATES
    assert found[0].name.startswith("a[2Jbcc")
    assert len(found[0].name) == 300
    assert [one.picture is not None for one in found] == [True, False, False, False, False, False]


@pytest.mark.parametrize(
    "value",
    [None, "ab", {}, [1], [{"name": "a"}], [{"name": 1, "description": ONE}]]
    + [[{"name": "a", "description": said}] for said in ({"no_entry": 1}, {"output_tanh": 7}, {"output_tanh": None})],
)
def test_what_is_no_candidate_is_left_out(value: Any, tmp_path: Path) -> None:
    assert read_candidates(value, tmp_path) == ()
