"""The picture of a field: what it shows, and what the gate lets through as one."""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from regnf_core.importing.gate import gate
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.picture import PICTURE_NAME, is_sound_picture
from regnf_core.viewing.field_picture import PANEL, field_picture
from tests.core.importing.archives import saved
from tests.core.surface.test_isosurface import ball, field_of


def png(mode: str = "RGB", size: tuple[int, int] = (8, 4)) -> bytes:
    buffer = io.BytesIO()
    Image.new(mode, size).save(buffer, "PNG")
    return buffer.getvalue()


def test_a_ball_looks_like_a_ball() -> None:
    sheet = np.asarray(field_picture(field_of(ball)))
    assert sheet.shape == (PANEL, 3 * PANEL, 3)
    left, right, section = (sheet[:, PANEL * i : PANEL * (i + 1)].astype(int) for i in range(3))
    for view in (left, right):
        shown = (np.abs(view - view[0, 0]).sum(axis=-1) > 30).mean()
        assert shown == pytest.approx(np.pi / 4 * 0.86**2, rel=0.05)  # a disc that fills 0.86 of the edge
    orange = (section[..., 0] > section[..., 2] + 20).mean()
    assert orange == pytest.approx(np.pi * 0.5**2 / 2.1**2, rel=0.1)  # the bounds' edge is 2, the margin a twentieth
    assert (section[..., 2] > section[..., 0] + 5).mean() > 0.5


def test_the_gate_leaves_a_picture_when_asked(tmp_path: Path) -> None:
    """And none otherwise, as test_gate.py shows."""
    upload = saved(tmp_path, trimesh.creation.icosphere(subdivisions=2, radius=0.5).export(file_type="stl"))
    report = import_field(upload, tmp_path / "with", {"label": "ball"}, picture=True)
    assert (report.family, report.label) == ("mesh", "ball")
    assert report.plausibility["gradient_median"] == pytest.approx(1.0, abs=1e-3)
    assert {path.name for path in (tmp_path / "with").iterdir()} == {gate.FIELD_NAME, PICTURE_NAME}
    with Image.open(tmp_path / "with" / PICTURE_NAME) as picture:
        assert picture.size == (3 * PANEL, PANEL)


def with_chunk(data: bytes) -> bytes:
    body = b"tEXtComment\0" + b"<script>"
    return data[:33] + (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big") + data[33:]


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data[:-1],
        lambda data: data + b"\0",
        lambda data: data[:60],
        lambda data: data[:45] + bytes([data[45] ^ 1]) + data[46:],
        lambda data: b"",
        lambda data: b"<svg/>",
        lambda data: png("L"),
        lambda data: png("RGB", (5000, 1)),
        with_chunk,
    ],
)
def test_what_is_no_plain_picture_is_none(change: Callable[[bytes], bytes], tmp_path: Path) -> None:
    assert not is_sound_picture(saved(tmp_path, change(png()), "bad"))


def test_links_and_folders_are_no_pictures(tmp_path: Path) -> None:
    good = saved(tmp_path, png(), "good")
    assert is_sound_picture(good)
    (tmp_path / "link").symlink_to(good)
    assert not is_sound_picture(tmp_path / "link")
    os.link(good, tmp_path / "twin")
    assert not is_sound_picture(good)
    assert not is_sound_picture(tmp_path)
    assert not is_sound_picture(tmp_path / "absent")
