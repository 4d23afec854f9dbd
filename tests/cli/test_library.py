"""``regnf library``: a folder's entries, archives of them, and searches among them."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from regnf_cli import main as cli
from regnf_core.errors import RegnfError
from regnf_core.library_entries import EntryNotes
from regnf_core.library_folder import INDEX, FolderEntry, LibraryFolder, digest_of, open_archive, write_archive
from tests.cli.conftest import Outcome, Run
from tests.core.importing.archives import zip_bytes
from tests.live_stack import DATA

CHAIR = DATA / "armchair.safetensors"
SYMMETRY = '{"order": 4, "axis": [0, 0, 1], "continuous": false}'


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> LibraryFolder:
    """A library with the demo's chair."""
    folder = tmp_path_factory.mktemp("library")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        said = ["--tag", "seat", "--unit", "m", "--library", str(folder)]
        patch.setattr("sys.argv", ["regnf", "library", "add", "arm chair", str(CHAIR), *said])
        assert cli.command() == 0
    return LibraryFolder(folder)


def test_an_entry_has_field_picture_and_symmetry(shelf: LibraryFolder) -> None:
    entry = shelf.get("arm chair")
    assert (entry.notes.tags, entry.notes.unit) == (("seat",), "m")
    assert entry.detected == {"order": 1, "axis": None, "continuous": False}
    assert digest_of(shelf.file(entry)) == entry.field
    assert shelf.picture(entry).read_bytes()[:4] == b"\x89PNG"
    assert [one.notes.name for one in shelf.entries(tag="seat", part="CHAIR")] == ["arm chair"]
    assert shelf.entries(tag="table") == shelf.entries(part="table") == []


def test_from_one_library_to_another_and_into_a_search(
    shelf: LibraryFolder, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, other = tmp_path / "chairs.zip", tmp_path / "other"

    def library(command: str, *said: object, folder: Path = other, code: int = 0) -> Outcome:
        return run("library", command, *said, "--library", folder, code=code)

    library("export", archive, folder=shelf.folder)
    first = archive.read_bytes()
    library("export", archive, folder=shelf.folder)
    assert archive.read_bytes() == first, "the same library gives the same bytes"
    assert "LIBRARY_NAME_TAKEN" in library("import", archive, folder=shelf.folder, code=2).stderr
    library("import", archive, "--skip-taken", folder=shelf.folder)
    library("import", archive)
    assert LibraryFolder(other).entries() == shelf.entries()
    library("edit", "arm chair", "--rename", "stool", "--tag", "none")
    (stool,) = LibraryFolder(other).entries()
    assert (stool.notes.name, stool.notes.tags, stool.notes.unit) == ("stool", (), "m")
    found = (shelf.get("arm chair").symmetry or {})["order"]
    for said, order, source in (("none", 1, "said"), ("detected", found, "detected"), (SYMMETRY, 4, "said")):
        library("edit", "stool", "--symmetry", said)
        (listed,) = json.loads(library("list", "--json").stdout)
        assert (listed["symmetry_source"], listed["symmetry"]["order"]) == (source, order)
    monkeypatch.setenv("REGNF_LIBRARY", str(other))
    search = ("search", DATA / "mix-room.safetensors", "--detection", DATA / "detection.json", "--json")
    missing = run(*search, "--tag", "seat")
    assert (missing.code, "no entries with the tag" in missing.stderr) == (2, True)
    ranked = run(*search)
    assert (ranked.code, json.loads(ranked.stdout)["candidates"][0]["object"]) == (0, "stool")
    library("remove", "stool")
    assert sorted(path.name for path in other.iterdir()) == [".lock", INDEX]


@pytest.fixture
def entry(tmp_path: Path) -> tuple[FolderEntry, Path]:
    field = tmp_path / "field"
    field.write_bytes(b"bytes of a field")
    return FolderEntry(EntryNotes.checked("chair"), digest_of(field)), field


def written(tmp_path: Path, entry: tuple[FolderEntry, Path], change: Callable[[dict[str, bytes]], None]) -> Path:
    """An archive whose members somebody has changed."""
    good, bad = tmp_path / "good.zip", tmp_path / "bad.zip"
    write_archive(good, [entry])
    with zipfile.ZipFile(good) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    bad.write_bytes(zip_bytes(list(members.items())))
    return bad


def index(**changes: Any) -> Callable[[dict[str, bytes]], None]:
    """Changes of the index' only entry."""

    def change(members: dict[str, bytes]) -> None:
        document = json.loads(members[INDEX])
        document["entries"][0] |= changes
        members[INDEX] = json.dumps(document).encode()

    return change


def field_of(members: dict[str, bytes]) -> str:
    return next(name for name in members if name != INDEX)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda members: members.pop(INDEX), "LIBRARY_INDEX_INVALID"),
        (lambda members: members.update({INDEX: b"[" * 100_000}), "LIBRARY_INDEX_INVALID"),
        (lambda members: members.update({INDEX: b'{"format": 2, "entries": []}'}), "LIBRARY_INDEX_INVALID"),
        (lambda members: members.update({INDEX: b'{"format": 1, "entries": 3}'}), "LIBRARY_INDEX_INVALID"),
        (lambda members: members.update(more=b"what no index names"), "ARCHIVE_MALFORMED"),
        (lambda members: members.pop(field_of(members)), "ARCHIVE_MALFORMED"),
        (lambda members: members.update({field_of(members): b"other bytes"}), "ARCHIVE_HASH_MISMATCH"),
        (index(name="../../etc/passwd"), "LIBRARY_INDEX_INVALID"),
        (index(field="../" + "a" * 61), "LIBRARY_INDEX_INVALID"),
        (index(field="b" * 64), "ARCHIVE_MALFORMED"),
        (index(tags=[3]), "LIBRARY_INDEX_INVALID"),
        (index(unit="parsec"), "LIBRARY_INDEX_INVALID"),
        (index(detected_symmetry={"order": 1e99}), "LIBRARY_INDEX_INVALID"),
    ],
)
def test_archives_that_were_changed_are_refused(
    tmp_path: Path, entry: tuple[FolderEntry, Path], change: Callable[[dict[str, bytes]], None], reason: str
) -> None:
    path = written(tmp_path, entry, change)
    with pytest.raises(RegnfError) as caught, open_archive(path) as archive:
        archive.extract(archive.entries[0], tmp_path / "out")
    assert caught.value.reason == reason


def test_files_that_are_no_archives_are_refused(tmp_path: Path, entry: tuple[FolderEntry, Path]) -> None:
    write_archive(tmp_path / "good.zip", [entry])
    whole = (tmp_path / "good.zip").read_bytes()
    index = json.dumps({"format": 1, "entries": []}) + " " * 100_000
    packed = zip_bytes([(INDEX, index.encode())], zipfile.ZIP_DEFLATED)
    for data, reason in (
        (b"", "FILE_EMPTY"),
        (b"no archive", "ARCHIVE_PREFIXED_DATA"),
        (whole + b"more", "ARCHIVE_TRAILING_DATA"),
        (whole[:-30], "FILE_TRUNCATED"),
        (packed, "ARCHIVE_COMPRESSED_ENTRY"),
    ):
        path = tmp_path / "bad.zip"
        path.write_bytes(data)
        with pytest.raises(RegnfError) as caught, open_archive(path):
            pass
        assert caught.value.reason == reason
