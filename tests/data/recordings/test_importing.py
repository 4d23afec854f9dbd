"""Recordings imported in the sandbox: archives, bags, stored recordings; what an archive must not do."""

from __future__ import annotations

import os
import shutil
import tarfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate import gate
from regnf_core.importing.gate.report import MIB, ImportLimits
from regnf_data.recordings.importing import import_recording
from regnf_data.recordings.stored import read_stored
from tests.data.recordings import writers
from tests.data.recordings.truth import HEIGHT, WIDTH, Truth, walk


@cache
def truth() -> Truth:
    return walk(4)


def packed(folder: Path, kind: str) -> Path:
    return Path(shutil.make_archive(str(folder), kind, folder.parent, folder.name))


UPLOADS: dict[str, Callable[[Path], Path]] = {
    "zip of BOP": lambda folder: packed(writers.bop(folder / "scene é 1", truth()), "zip"),
    "tar.gz of TUM": lambda folder: packed(writers.tum(folder / "r", truth()), "gztar"),
    "mcap": lambda folder: next(writers.bag(folder / "r", truth()).glob("*.mcap")),
    "zip of a bag": lambda folder: packed(writers.bag(folder / "r", truth(), "sqlite3", "compressedDepth"), "zip"),
}


@pytest.mark.parametrize("kind", UPLOADS)
def test_an_upload_becomes_a_stored_recording(kind: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = import_recording(UPLOADS[kind](tmp_path), out)
    assert (report["kind"], report["left_out"], report["size"]) == ("recording", 0, [HEIGHT, WIDTH])
    assert report["color_size"] == [HEIGHT, WIDTH]
    assert report["warnings"] == []
    assert len(report["frames"]) == len(truth())
    assert all(report["isolation"].values())
    assert os.listdir(out) == ["field.safetensors"]
    recording = read_stored(out / "field.safetensors")
    for index, stored in enumerate(recording.frames):
        np.testing.assert_allclose(stored.read().depth, truth().depths[index], atol=0.00062)
    if kind == "mcap":  # and once more what was stored
        again = import_recording(out / "field.safetensors", tmp_path / "again")
        assert again["frames"] == report["frames"]


@pytest.mark.parametrize("killed", [False, True])
def test_a_process_that_was_started_early_imports_as_any_other(killed: bool, tmp_path: Path) -> None:
    gate.start_early(import_recording.__module__)
    process = gate._early[import_recording.__module__]
    if killed:
        process.kill()
    report = import_recording(UPLOADS["zip of BOP"](tmp_path), tmp_path / "out")
    assert not gate._early
    assert (process.returncode == 0) == (not killed)
    assert len(report["frames"]) == len(truth())
    assert all(report["isolation"].values())
    assert os.listdir(tmp_path / "out") == ["field.safetensors"]


def bomb(folder: Path) -> Path:
    """Many PNGs of zeros: a thousand times larger once they are decoded."""
    image = writers.png_bytes(np.zeros((4000, 4000), np.uint16))
    with zipfile.ZipFile(folder / "b.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("camera.txt", "3000 3000 2000 2000")
        for number in range(100):
            archive.writestr(f"f-{number}.depth.png", image)
            archive.writestr(f"f-{number}.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    return folder / "b.zip"


def outside(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "o.zip", "w") as archive:
        archive.writestr("../../depth.png", b"x")
    return folder / "o.zip"


def linked(folder: Path) -> Path:
    with tarfile.open(folder / "l.tar", "w") as archive:
        link = tarfile.TarInfo("depth.png")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    return folder / "l.tar"


def inflated(folder: Path) -> Path:
    """Two hundred megabytes of zeros in two hundred kilobytes."""
    with zipfile.ZipFile(folder / "i.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", bytes(1 << 28))
    return folder / "i.zip"


def inverted(folder: Path) -> Path:
    wrong = Truth(truth().depths, truth().colors, np.linalg.inv(truth().poses), truth().stamps)
    return packed(writers.seven_scenes(folder / "r", wrong), "zip")


def text(folder: Path) -> Path:
    (folder / "t.zip").write_bytes(b"no archive at all, only a text of some length" * 9)
    return folder / "t.zip"


def empty(folder: Path) -> Path:
    (folder / "e.zip").write_bytes(b"PK\x05\x06" + bytes(18))
    return folder / "e.zip"


def hollow(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "h.zip", "w") as archive:
        archive.writestr("kitchen/", "")
    return folder / "h.zip"


def unknown(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "u.zip", "w") as archive:
        archive.writestr("readme.txt", "nothing to see")
    return folder / "u.zip"


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a path outside": (outside, "ARCHIVE_ENTRY_NAME"),
    "a link": (linked, "ARCHIVE_LINK"),
    "a file that grows": (inflated, "ARCHIVE_TOO_LARGE|RUN_TOO_LARGE"),
    "inverted poses": (inverted, "DATASET_FRAMES_DISAGREE"),
    "no archive": (text, "DATASET_NOT_RECOGNIZED|DATASET_FILE_INVALID"),
    "nothing in it": (empty, "ARCHIVE_|DATASET_NOT_RECOGNIZED"),
    "a folder without files": (hollow, "DATASET_NOT_RECOGNIZED"),
    "no recording in it": (unknown, "DATASET_NOT_RECOGNIZED"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_recording_is_refused_and_leaves_nothing(kind: str, tmp_path: Path) -> None:
    make, reason = REFUSED[kind]
    with pytest.raises(FieldFormatError) as refused:
        import_recording(make(tmp_path), tmp_path / "out")
    assert any(refused.value.reason.startswith(one) for one in reason.split("|")), refused.value
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.long
def test_images_that_grow_end_within_their_limits(tmp_path: Path) -> None:
    limits = ImportLimits(wall_s=10.0, memory_bytes=2048 * MIB, file_bytes=1024 * MIB)
    with pytest.raises(FieldFormatError) as refused:
        import_recording(bomb(tmp_path), tmp_path / "out", None, limits)
    assert refused.value.reason in ("DATASET_DEPTH_MISSING", "IMPORT_TIMEOUT", "IMPORT_OUT_OF_MEMORY")
    assert list((tmp_path / "out").iterdir()) == []


def test_one_frame_says_its_pose_and_unit(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as archive:
        archive.writestr("depth.png", writers.png_bytes(np.round(5000.0 * truth().depths[0]).astype(np.uint16)))
        archive.writestr("color.png", writers.png_bytes(truth().colors[0]))
        archive.writestr("mask.png", writers.png_bytes(np.zeros((HEIGHT, WIDTH), np.uint8)))
        pose = np.round(truth().poses[0], 12).tolist()
        archive.writestr(
            "camera.json",
            f'{{"fx": 70, "fy": 72, "cx": 39, "cy": 31, "depth_unit": 0.0002, "T_world_camera": {pose}}}',
        )
    report = import_recording(tmp_path / "f.zip", tmp_path / "out")
    frame = read_stored(tmp_path / "out" / "field.safetensors").frames[0].read()
    np.testing.assert_allclose(frame.depth, truth().depths[0], atol=0.0002)
    np.testing.assert_allclose(frame.T_world_camera, truth().poses[0], atol=1e-9)
    assert report["layout"] == "one frame"
