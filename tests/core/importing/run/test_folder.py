"""Runs on the user's own disk: found, packed, and never read beyond their folder."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest
import torch

from regnf_core.field_source import find_source
from regnf_core.importing.run import folder as runs
from regnf_core.importing.run.folder import Run, find_run, pack_settings, settings_beside
from tests.core.importing.archives import assert_refused


def lay_out(root: Path, *names: str) -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return root


def test_a_run_is_found_and_its_settings_are_packed(tmp_path: Path) -> None:
    run = lay_out(tmp_path / "run", "config.yml", "nerfstudio_models/step-10.ckpt", "nerfstudio_models/step-9.ckpt")
    found = find_run(run)
    assert found == Run(run / "nerfstudio_models/step-10.ckpt", (run / "config.yml",))
    assert settings_beside(found.checkpoint) == found.settings
    packed = pack_settings(found, tmp_path)
    with tarfile.open(packed) as archive:
        assert archive.getnames() == ["config.yml"]
    assert packed.read_bytes() == pack_settings(found, tmp_path).read_bytes()


def test_a_file_of_the_dataset_joins_the_settings_of_the_run(tmp_path: Path) -> None:
    run = lay_out(tmp_path / "run", "config.yml", "meta_data.json", "sdfstudio_models/step-10.ckpt")
    torch.save({}, run / "sdfstudio_models/step-10.ckpt")
    data = lay_out(tmp_path / "data", "meta_data.json", "other.yml")
    found = find_source(run, config=data / "meta_data.json")
    assert (found.settings, found.config) == ((run / "config.yml", data / "meta_data.json"), None)
    with found.packed_settings() as packed, tarfile.open(packed) as archive:
        assert archive.getnames() == ["run/config.yml", "data/meta_data.json"]
    assert find_source(run, config=data / "other.yml").settings == (data / "other.yml",)
    assert find_source(run, config=False).settings == ()
    (run / "config.yml").unlink()
    (run / "meta_data.json").unlink()
    assert find_source(run, config=data / "meta_data.json").settings == (data / "meta_data.json",)


def test_settings_in_folders_of_their_own_are_found(tmp_path: Path) -> None:
    lay_out(tmp_path, "e/case/recording/womask.conf", "e/case/checkpoints/ckpt_1.pth", "e/other/recording/b.conf")
    found = settings_beside(tmp_path / "e/case/checkpoints/ckpt_1.pth")
    assert found == (tmp_path / "e/case/recording/womask.conf",)


def test_links_out_of_the_run_are_not_followed(tmp_path: Path) -> None:
    outside = lay_out(tmp_path / "outside", "secret.yml", "model.ckpt", "deep/config.yml")
    run = lay_out(tmp_path / "run", "nerfstudio_models/step-1.ckpt", "inside.yml")
    (run / "config.yml").symlink_to(outside / "secret.yml")
    (run / "nerfstudio_models/step-2.ckpt").symlink_to(outside / "model.ckpt")
    (run / "more").symlink_to(outside)
    (run / "loop").symlink_to(run)
    assert find_run(run) == Run(run / "nerfstudio_models/step-1.ckpt", ())
    (run / "config.yaml").symlink_to(run / "inside.yml")
    assert find_run(run).settings == (run / "config.yaml",)


def test_a_folder_of_too_many_files_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lay_out(tmp_path, *(f"{i}.txt" for i in range(12)))
    monkeypatch.setattr(runs, "_MAX_FILES", 10)
    assert_refused(lambda: find_run(tmp_path), "RUN_TOO_LARGE")


def test_settings_of_too_many_bytes_are_not_packed(tmp_path: Path) -> None:
    run = lay_out(tmp_path / "run", "nerfstudio_models/step-1.ckpt", "config.yml")
    with open(run / "config.yml", "r+b") as file:
        file.truncate(65 << 20)
    assert_refused(lambda: pack_settings(find_run(run), tmp_path), "SETTINGS_TOO_LARGE")
