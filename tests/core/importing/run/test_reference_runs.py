"""Runs as their trainers leave them, whole or packed, against values computed by the trainers' own code."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.containers import zip_members
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.gate import import_field
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.run.folder import find_run, pack_settings
from regnf_core.importing.run.opened import open_upload
from tests.core.importing.archives import assert_refused, zip_bytes
from tests.core.importing.test_reference_checkpoints import assert_reproduces
from tests.devdata import dev_data

FAMILIES = (
    *("deepsdf", "instant_nsr_pl", "neuralangelo", "neus", "nerfstudio_neus_facto"),
    *("sdfstudio_neus_facto", "sdfstudio_neus_facto_angelo", "sdfstudio_neus"),
)
IN_THE_DATASET = ("neuralangelo", "neus", "deepsdf", "nerfstudio_neus_facto")
SAID: dict[str, dict[str, Any]] = {"deepsdf": {"latent_index": 1}}


def with_settings(folder: Path, out: Path, said: dict[str, Any] | None = None) -> dict[str, Any]:
    """The report of the run in ``folder``, its settings packed as for the gate."""
    run = find_run(folder)
    packed = pack_settings(run, out)
    return convert_file(run.checkpoint, out, said, ImportLimits(), beside=Companions(settings=(packed.name, packed)))


def zipped(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, Path("run") / path.relative_to(folder))
    return buffer.getvalue()


def tarred(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        archive.add(folder, "./run/" + "long-" * 30)  # beyond what the plain header holds
    return buffer.getvalue()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_run_with_its_settings_is_reproduced(tmp_path: Path, family: str) -> None:
    """Where the dataset's frame is known, in that: the same values at the same places, in the dataset's unit."""
    folder, placed = dev_data("formats", family), family in IN_THE_DATASET
    report = with_settings(folder, tmp_path, SAID.get(family, {}) | ({"frame": "dataset"} if placed else {}))
    assert report["family"] == report["settings"]["used"]["family"] == family
    warned = ["LEVEL_MASK_ASSUMED"] if family.endswith("angelo") and family.startswith("sdf") else []
    warned += ["COLOR_LEFT_OUT"] if family == "neuralangelo" else []
    assert [warning.partition(":")[0] for warning in report["warnings"]] == warned
    if not placed:
        assert_reproduces(tmp_path / FIELD_NAME, folder)
        return
    world, own = (np.load(folder / name).astype(np.float64) for name in ("points_world.npy", "points.npy"))
    unit = np.linalg.norm(world[1] - world[0]) / np.linalg.norm(own[1] - own[0])
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(torch.from_numpy(world).float())
    expected = unit * np.load(folder / "sdf.npy").reshape(-1)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5 * np.ptp(expected))
    steepness = np.linalg.norm(np.load(folder / "gradient.npy"), axis=1)
    np.testing.assert_allclose(gradient.norm(dim=1).numpy(), steepness, rtol=0, atol=1e-3)
    if family == "neuralangelo":
        np.testing.assert_allclose(report["bounds"], [[-1.55, -2.15, -0.65], [1.95, 1.35, 2.85]], atol=1e-6)


def test_a_whole_run_in_one_archive_is_reproduced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However it is packed, the same is in it. A zip is listed once, and so is the checkpoint's own."""
    folder, listed = dev_data("formats", "instant_nsr_pl"), []
    inner = zip_members._directory_end
    monkeypatch.setattr(zip_members, "_directory_end", lambda data: listed.append(len(data)) or inner(data))
    upload = tmp_path / "run.zip"
    upload.write_bytes(zipped(folder / "exp"))
    report = convert_file(upload, tmp_path, None, ImportLimits())
    assert report["settings"]["trainer"] == "instant-nsr-pl"
    assert report["why"][0].endswith("ckpt/epoch=0-step=20000.ckpt")
    assert_reproduces(tmp_path / FIELD_NAME, folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == [FIELD_NAME, upload.name]
    (checkpoint,) = (folder / "exp").rglob("epoch=0-step=20000.ckpt")
    assert listed == [upload.stat().st_size, checkpoint.stat().st_size]
    tar = tarred(folder / "exp")
    for data in (tar, gzip.compress(tar, 1), bz2.compress(tar, 1), lzma.compress(tar, preset=0)):
        opened = open_upload(memoryview(data), tmp_path, 1 << 30)
        assert bytes(opened.data) == checkpoint.read_bytes()
        assert [Path(file.name).name for file in opened.settings] == report["settings"]["files"]


def test_a_run_through_the_gate_s_own_process(tmp_path: Path) -> None:
    """The settings are opened before the process is confined, and what is unpacked lies in its own folder."""
    folder = dev_data("formats", "neuralangelo")
    upload = tmp_path / "run.tgz"
    upload.write_bytes(gzip.compress(tarred(folder / "logs")))
    sphere = folder / "datasets" / "toy" / "transforms.json"
    report = import_field(upload, tmp_path / "packed", {"frame": "field"})
    assert report.settings is not None
    assert report.settings["files"] == ["config.yaml"]
    beside = with_settings(folder, tmp_path)
    assert beside["settings"]["files"] == ["config.yaml", sphere.name]
    assert any("dataset's frame is known" in line for line in beside["why"])


def test_world_scale_scales_the_dataset_s_unit(tmp_path: Path) -> None:
    folder = dev_data("formats", "neuralangelo")
    with_settings(folder, tmp_path, {"frame": "dataset", "world_scale": 0.1})
    points = 0.1 * torch.from_numpy(np.load(folder / "points_world.npy")).float()
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(points)
    expected = 0.175 * np.load(folder / "sdf.npy").reshape(-1)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=2e-5 * np.ptp(expected))


def test_a_placed_field_is_taken_again_and_stays_where_it_is(tmp_path: Path) -> None:
    folder = dev_data("formats", "neuralangelo")
    with_settings(folder, tmp_path, {"frame": "dataset"})
    again = tmp_path / "again"
    again.mkdir()
    convert_file(tmp_path / FIELD_NAME, again, {"label": "placed"}, ImportLimits())
    points = torch.from_numpy(np.load(folder / "points_world.npy")).float()
    before, after = (open_field(path / FIELD_NAME).signed_distance(points) for path in (tmp_path, again))
    assert torch.equal(before, after)
    convert_file(tmp_path / FIELD_NAME, again, {"world_scale": 2.0}, ImportLimits())
    doubled = open_field(again / FIELD_NAME).signed_distance(2.0 * points)
    torch.testing.assert_close(doubled, 2.0 * before, rtol=1e-4, atol=1e-5)
    for said in ({"bounds": [[-1, -1, -1], [1, 1, 1]]}, {"frame": "dataset"}):
        assert_refused(
            lambda said=said: convert_file(tmp_path / FIELD_NAME, again, said, ImportLimits()), "INVALID_DESCRIPTION"
        )


def test_the_dataset_s_frame_must_be_known(tmp_path: Path) -> None:
    checkpoint = find_run(dev_data("formats", "neuralangelo")).checkpoint
    with pytest.raises(FieldFormatError, match=r"dataparser_transforms\.json") as refused:
        convert_file(checkpoint, tmp_path, {"frame": "dataset"}, ImportLimits())
    assert refused.value.reason == "INVALID_DESCRIPTION"


def test_a_mesh_finds_its_buffers_in_the_archive(tmp_path: Path) -> None:
    files = trimesh.creation.icosphere(subdivisions=2).export(file_type="gltf")
    upload = tmp_path / "ball.zip"
    upload.write_bytes(zip_bytes([(f"scan/{name}", data) for name, data in files.items()]))
    report = convert_file(upload, tmp_path, None, ImportLimits())
    assert report["family"] == "mesh"
    assert report["why"][0] == "the run's checkpoint is scan/model.gltf"


def test_another_run_s_settings_are_refused(tmp_path: Path) -> None:
    checkpoint = find_run(dev_data("formats", "neuralangelo")).checkpoint
    other = find_run(dev_data("formats", "instant_nsr_pl")).settings[0]
    assert_refused(
        lambda: convert_file(
            checkpoint, tmp_path, None, ImportLimits(), beside=Companions(settings=(other.name, other))
        ),
        "FAMILY_NOT_SUPPORTED",
    )
