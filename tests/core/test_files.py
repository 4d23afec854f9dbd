"""Files appear complete or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from regnf_core.errors import atomic_path


@pytest.mark.parametrize("durable", [False, True])
def test_the_file_appears_at_the_end(tmp_path: Path, durable: bool) -> None:
    target = tmp_path / "field.bin"
    target.write_text("old")
    with atomic_path(target, durable) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
        assert temporary.parent == target.parent
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["field.bin"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_no_other(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "field.bin"
    target.write_text("old")

    def interrupted() -> None:
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        interrupted()
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["field.bin"]


def test_a_durable_file_is_on_the_disk_before_it_is_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "field.bin"
    flushed: list[str] = []

    def flush(descriptor: int) -> None:
        assert not target.exists()
        flushed.append(os.readlink(f"/proc/self/fd/{descriptor}"))

    monkeypatch.setattr(os, "fsync", flush)
    with atomic_path(target, durable=True) as temporary:
        temporary.write_text("content")
    assert flushed == [str(temporary)]
    with atomic_path(tmp_path / "other.bin") as other:
        other.write_text("content")
    assert len(flushed) == 1
