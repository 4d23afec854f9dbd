"""What the commands take for a field: a file, a run's folder, settings, descriptions; and the warnings of imports."""

from __future__ import annotations

import json
import re
import shutil
import tarfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh

from regnf_core import FieldWarning, open_field
from regnf_core.importing.gate.report import ImportReport
from tests.cli.conftest import DATA, Run
from tests.devdata import dev_data

WARNING = "TRUNCATION_ASSUMED: taken for 8 voxels"


def contents(settings: Path | None) -> bytes | None:
    """Of a file of settings, or of all in an archive of them."""
    if settings is None or not tarfile.is_tarfile(settings):
        return None if settings is None else settings.read_bytes()
    with tarfile.open(settings) as archive:
        return b"".join(archive.extractfile(member).read() for member in archive)  # type: ignore[union-attr]


@dataclass
class Gate:
    """Stands in for the import gate: what it was given, and the demo's armchair as every field."""

    asked: list[dict[str, Any]] = field(default_factory=list)

    def import_field(
        self,
        upload: Path,
        out_dir: Path,
        description: dict[str, Any] | None = None,
        limits: object = None,
        picture: bool = False,
        settings: Path | None = None,
        cameras: Path | None = None,
    ) -> ImportReport:
        assert cameras is None
        self.asked.append({"file": upload.name, "description": description, "settings": contents(settings)})
        name = "mix-room" if "room" in upload.name else "armchair"
        shutil.copy(DATA / f"{name}.safetensors", out_dir / "field.safetensors")
        used = None if settings is None else {"trainer": "neus", "files": ["config.yml"], "used": {}}
        told: dict[str, Any] = {"family": "deepsdf", "kind": "sdf", "why": (), "parameters": 1, "plausibility": {}}
        told |= {"bounds": ((0, 0, 0), (1, 1, 1)), "surface_bounds": ((0, 0, 0), (1, 1, 1))}
        told |= {"warnings": (WARNING,), "assumed": (), "label": None, "settings": used}
        told |= {"field_bytes": 1, "seconds": 0.1, "cpu_seconds": 0.1, "peak_memory_bytes": 1, "isolation": {}}
        return ImportReport(**told)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Gate:
    made = Gate()
    monkeypatch.setattr("regnf_core.importing.gate.gate.import_field", made.import_field)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return made


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A training run: its settings, and checkpoints of two steps."""
    models = tmp_path / "outputs" / "room" / "sdfstudio_models"
    models.mkdir(parents=True)
    (models.parent / "config.yml").write_text("method: neus\n")
    for step in (10, 30):
        torch.save({"step": step}, models / f"step-{step:09d}.ckpt")
    return models.parent


def opened(path: Path, **how: Any) -> None:
    with pytest.warns(FieldWarning, match="TRUNCATION_ASSUMED"):
        assert open_field(path, **how).bounds.shape == (2, 3)


def test_a_runs_folder_is_its_latest_checkpoint_with_its_settings(gate: Gate, run_folder: Path) -> None:
    opened(run_folder)
    opened(run_folder / "sdfstudio_models" / "step-000000010.ckpt")
    wanted = {"description": None, "settings": b"method: neus\n"}
    assert gate.asked == [{"file": f"step-{step:09d}.ckpt"} | wanted for step in (30, 10)]


def test_what_was_imported_is_kept_for_the_same_file_settings_and_description_unless_its_notes_are_damaged(
    gate: Gate, run_folder: Path, tmp_path: Path
) -> None:
    for _ in range(2):
        opened(run_folder)
    assert len(gate.asked) == 1
    opened(run_folder, config=False)
    opened(run_folder, description={"sign": -1})
    (run_folder / "config.yml").write_text("method: neus-facto\n")
    opened(run_folder)
    other = run_folder.parent / "other.yml"
    other.write_text("method: neus-facto\n")
    opened(run_folder, config=other)
    for notes in (tmp_path / "cache" / "regnf" / "fields").glob("*.json"):
        notes.write_text("[")
    opened(run_folder)
    assert [(one["description"], one["settings"]) for one in gate.asked[1:]] == [
        (None, None),
        ({"sign": -1}, b"method: neus\n"),
        (None, b"method: neus-facto\n"),
        (None, b"method: neus-facto\n"),
        (None, b"method: neus-facto\n"),
    ]


def registration(room: Path, chair: Path, *more: object) -> list[object]:
    return ["register", room, chair, "--detection", DATA / "detection.json", *more]


def test_what_is_asked_decides_where_the_file_does_not(gate: Gate, run: Run, tmp_path: Path) -> None:
    for name in ("room", "chair"):
        trimesh.creation.box().export(tmp_path / f"{name}.ply")
    run(*registration(tmp_path / "room.ply", tmp_path / "chair.ply"), code=0)
    assert [one["description"] for one in gate.asked] == [{"as": "scene"}, {"as": "object"}]
    run(*registration(tmp_path / "room.ply", tmp_path / "chair.ply", "--object-description", '{"as": "scene"}'))
    assert gate.asked[2:] == [{"file": "chair.ply", "description": {"as": "scene"}, "settings": None}]


def test_a_result_repeats_what_the_imports_warned_of(gate: Gate, run: Run, run_folder: Path, tmp_path: Path) -> None:
    room = shutil.copy(run_folder / "sdfstudio_models/step-000000030.ckpt", run_folder / "sdfstudio_models/room.ckpt")
    outcome = run(*registration(room, DATA / "armchair.safetensors", "--output", tmp_path / "out"), code=0)
    assert re.search("settings: .*config.yml", outcome.stderr)
    assert f"warning      scene: {WARNING}\n" in outcome.stdout
    fields = json.loads((tmp_path / "out" / "result.json").read_text())["fields"]
    assert (fields["scene"]["warnings"], fields["scene"]["family"]) == ([WARNING], "deepsdf")
    assert fields["scene"]["settings"]["files"] == ["config.yml"]
    assert fields["object"] == {"family": None, "settings": None, "warnings": [], "assumed": []}
    assert gate.asked == [{"file": "room.ckpt", "description": None, "settings": b"method: neus\n"}]
    outcome = run(*registration(room, DATA / "armchair.safetensors", "--no-config"))
    assert "settings: " not in outcome.stderr
    assert gate.asked[1]["settings"] is None


def test_a_search_repeats_them_too(gate: Gate, run: Run, run_folder: Path) -> None:
    run_folder.joinpath("specs.yml").write_text("x: 1\n")
    arguments = ["search", DATA / "mix-room.safetensors", run_folder, "--detection", DATA / "detection.json"]
    outcome = run(*arguments, "--object-config", run_folder / "specs.yml", "--json")
    document = json.loads(outcome.stdout)
    assert (outcome.code, document["object"]) == (0, str(run_folder))
    assert document["fields"]["object"]["warnings"] == [WARNING]
    assert gate.asked == [{"file": "step-000000030.ckpt", "description": None, "settings": b"x: 1\n"}]


def test_inspect_and_convert_take_settings_and_descriptions(
    gate: Gate, run: Run, run_folder: Path, tmp_path: Path
) -> None:
    outcome = run("inspect", run_folder, "--json", "--description", '{"latent_index": 3}')
    assert (outcome.code, json.loads(outcome.stdout)["warnings"]) == (0, [WARNING])
    assert "settings: config.yml\n" in outcome.stderr
    said = ("--config", run_folder / "config.yml")
    for name, more in (("a.ply", ("--resolution", 8, "--no-config")), ("a.safetensors", said)):
        outcome = run("convert", run_folder, tmp_path / name, *more)
        assert (outcome.code, f"warning: {WARNING}\n" in outcome.stderr) == (0, True)
    assert [(one["description"], one["settings"]) for one in gate.asked] == [
        ({"latent_index": 3}, b"method: neus\n"),
        (None, None),
        (None, b"method: neus\n"),
    ]


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        ("MALFORMED_JSON", "{"),
        ("INVALID_DESCRIPTION", '{"sign": 3}'),
        ("INVALID_DESCRIPTION", '{"sing": -1}'),
        ("FILE_NOT_FOUND", "absent.json"),
        ("MALFORMED_JSON", '{"a": ' + "[" * 100_000),
        ("FILE_NOT_FOUND", None),
    ],
    ids=lambda value: str(value)[:20],
)
@pytest.mark.usefixtures("gate")
def test_descriptions_and_settings_that_are_refused(text: str | None, reason: str, run: Run, run_folder: Path) -> None:
    how = ["--config", run_folder / "absent.yml"] if text is None else ["--description", text]
    outcome = run("inspect", run_folder, *how)
    assert (outcome.code, outcome.stderr.partition(" ")[0]) == (2, reason)
    assert "hint: " in outcome.stderr


def test_settings_that_all_may_write_or_of_a_whole_home_are_no_runs(
    gate: Gate, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = run_folder / "sdfstudio_models" / "step-000000030.ckpt"
    run_folder.chmod(0o1777)
    opened(checkpoint)
    run_folder.chmod(0o755)
    monkeypatch.setenv("HOME", str(run_folder))
    opened(checkpoint)
    monkeypatch.setenv("HOME", str(run_folder.parents[1] / "home"))
    opened(checkpoint)
    assert [one["settings"] for one in gate.asked] == [None, b"method: neus\n"], "the first is kept, and found again"


def test_settings_that_were_found_and_do_not_read_can_be_left(run: Run, run_folder: Path) -> None:
    (run_folder / "config.yml").write_text("a: [")
    outcome = run("inspect", run_folder, code=2)
    assert outcome.stderr.splitlines()[2].startswith("SETTINGS_")
    assert "--no-config" in outcome.stderr


def test_a_real_run_is_inspected_in_an_archive(run: Run, tmp_path: Path) -> None:
    archive = shutil.make_archive(str(tmp_path / "run"), "gztar", dev_data("formats", "neus", "exp"))
    outcome = run("inspect", archive, "--json", code=0)
    report = json.loads(outcome.stdout)
    assert (report["family"], report["settings"]["trainer"]) == ("neus", "NeuS")
