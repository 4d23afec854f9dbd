"""Files that a new user gives by mistake, at the command line."""

# ruff: noqa: E501 -- a mistake is one line of a table
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.cli.conftest import DATA, Run
from tests.core.importing.archives import zip_bytes
from tests.mistakes.case import Case, parametrized

FIELD = "expected a f|not a field|not the file|truncated|empty|unpack"


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def cut_checkpoint(folder: Path) -> None:
    import torch

    torch.save({"weights": torch.zeros(1000)}, folder / "whole.ckpt")
    (folder / "cut.ckpt").write_bytes((folder / "whole.ckpt").read_bytes()[:2000])


def foreign_checkpoint(folder: Path) -> None:
    import torch

    torch.save({"encoder": torch.zeros(10)}, folder / "other.ckpt")


CASES = [
    Case("scene missing", "FILE_NOT_FOUND", 2, "rom.safetensors", "no such file", "Did you mean room.safetensors", "rom.safetensors"),
    Case("another ending", "FILE_NOT_FOUND", 2, "room.ckpt", "no such file", "Did you mean room.safetensors", "room.ckpt"),
    Case("folder missing", "FILE_NOT_FOUND", 2, "exports/room.ckpt", "no such file", "There is no folder exports", "exports/room.ckpt"),
    Case("empty folder", "RUN_WITHOUT_CHECKPOINT", 2, "nothing", "checkpoint", "Give the folder of one training run", "nothing"),
    Case("folder of a run cut short", "FILE_TRUNCATED", 2, "run/sdfstudio_models/step-000030000.ckpt", "truncated|too early|ends", "again", "run"),
    Case("config of a run", "FORMAT_NOT_RECOGNIZED", 2, "run/config.yml", FIELD, "mean run/sdfstudio_models/step-000030000.ckpt", "run/config.yml"),
    Case("detection as scene", "FORMAT_NOT_RECOGNIZED", 2, "box.json", FIELD, "mean run/|checkpoint", "box.json"),
    Case("empty file", "FILE_EMPTY", 2, "a.ckpt", FIELD, "again", "a.ckpt", write("a.ckpt", b"")),
    Case("picture", "FORMAT_NOT_RECOGNIZED", 2, "a.ckpt: a PNG", FIELD, "checkpoint", "a.ckpt", write("a.ckpt", b"\x89PNG\r\n\x1a\n0000")),
    Case("photo", "FORMAT_NOT_RECOGNIZED", 2, "a.jpg: a JPEG", FIELD, "checkpoint", "a.jpg", write("a.jpg", b"\xff\xd8\xff\xe0000")),
    Case("web page", "FORMAT_NOT_RECOGNIZED", 2, "a.ckpt: an HTML page", FIELD, "download", "a.ckpt", write("a.ckpt", b"<!DOCTYPE html><html>")),
    Case("Git LFS pointer", "FORMAT_NOT_RECOGNIZED", 2, "a.ckpt", FIELD, "git lfs pull", "a.ckpt", write("a.ckpt", b"version https://git-lfs.github.com/spec/v1\n")),
    Case("gzip archive", "FILE_TRUNCATED", 2, "a.tar.gz", "truncated", "again", "a.tar.gz", write("a.tar.gz", b"\x1f\x8b\x08\0\0\0")),
    Case("notes", "FORMAT_NOT_RECOGNIZED", 2, "notes.txt", FIELD, "checkpoint|mean", "notes.txt", write("notes.txt", b"to do")),
    Case("bare pickle", "RAW_PICKLE", 2, "a.pkl", "torch.save", "Save it again", "a.pkl", write("a.pkl", b"\x80\x04\x95\0\0\0\0}.")),
    Case("zip of other things", "RUN_WITHOUT_CHECKPOINT", 2, "a.zip", "checkpoint", "regnf manual import-gate", "a.zip", write("a.zip", zip_bytes([("a.txt", b"to do")]))),
    Case("truncated checkpoint", "FILE_TRUNCATED", 2, "cut.ckpt", "truncated", "again", "cut.ckpt", cut_checkpoint),
    Case("truncated safe field", "SAFE_FORMAT_INVALID", 2, "a.safetensors", "safetensors", "again|docs", "a.safetensors", lambda folder: (folder / "a.safetensors").write_bytes((DATA / "armchair.safetensors").read_bytes()[:3000])),
    Case("checkpoint of another network", "FIELD_NOT_RECOGNIZED", 2, "other.ckpt.*encoder", "family of the field is unknown", "regnf manual import-gate", "other.ckpt", foreign_checkpoint),
]  # fmt: skip


@parametrized(CASES)
def test_a_wrong_scene(case: Case, run: Run, folder: Path) -> None:
    case.prepare(folder)
    outcome = run("register", case.how, "chair.safetensors", "--detection", "box.json", code=case.code)
    assert case.reason in outcome.stderr
    assert outcome.stdout == ""
    case.check(outcome.stderr)


def test_inspect_and_convert_name_the_file_too(run: Run, folder: Path) -> None:
    (folder / "page.ckpt").write_bytes(b"<html>")
    for arguments in (["inspect", "page.ckpt"], ["convert", "page.ckpt", "out.ply"], ["inspect", "run"]):
        outcome = run(*arguments, code=2)
        assert arguments[1] in outcome.stderr
        assert "hint: " in outcome.stderr
