"""Every blob store keeps the same promises; the local one also keeps its volume clean."""

import errno
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from regnf_state.blobs.base import BlobStore, FileCache, StorageFullError, StorageUnavailableError
from regnf_state.blobs.local import LocalBlobStore
from regnf_state.blobs.object_store import ObjectBlobStore
from tests.object_store import ObjectServer, environment

BAD_KEYS = [
    "",
    "/",
    "/etc/passwd",
    "../x",
    "a/../b",
    "a/..",
    "./a",
    "a//b",
    "a/",
    "a\\b",
    "a\0b",
    "a\nb",
    "ä",
    ".tmp/x",
]
BAD_KEYS += ["a" * 201, "/".join(["a" * 100] * 6)]


@pytest.fixture(params=["local", "objects"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[BlobStore]:
    if request.param == "local":
        yield LocalBlobStore(tmp_path / "blobs")
    else:
        server: ObjectServer = request.getfixturevalue("objects")
        with environment(server.environment):
            yield ObjectBlobStore(f"s3://{server.new_bucket()}/some/prefix")


def test_what_is_put_is_read(store: BlobStore) -> None:
    store.put("jobs/a/manifest.json", b"first")
    store.put("jobs/a/manifest.json", b"second")
    with store.open("jobs/a/manifest.json") as file:
        assert file.read() == b"second"
    assert store.exists("jobs/a/manifest.json")
    with store.local_copy("jobs/a/manifest.json") as path:
        assert path.read_bytes() == b"second"


def test_missing_blobs_are_told(store: BlobStore) -> None:
    assert not store.exists("jobs/a")
    with pytest.raises(FileNotFoundError):
        store.open("jobs/a")
    with pytest.raises(FileNotFoundError), store.local_copy("jobs/a"):
        pass
    store.delete("jobs/a")
    store.delete_prefix("jobs/a")


def test_streamed_blobs_appear_whole_or_not_at_all(store: BlobStore) -> None:
    with store.writer() as writer:
        writer.write(b"one ")
        writer.write(b"two")
        assert list(store.list("")) == []
        writer.commit("fields/f/original")
    with store.writer() as writer:
        writer.write(b"never named")
    with pytest.raises(TypeError), store.writer() as writer:
        writer.write(b"broken off" + None)  # type: ignore[operator]
    assert list(store.list("")) == ["fields/f/original"]
    with store.open("fields/f/original") as file:
        assert file.read() == b"one two"


def test_only_the_first_of_several_writers_wins(store: BlobStore) -> None:
    assert store.put_if_absent("jobs/a/manifest.json", b"")
    assert not store.put_if_absent("jobs/a/manifest.json", b"")
    assert not store.put_if_absent("jobs/a/manifest.json", b"second")
    assert [entry.bytes for entry in store.entries("jobs/a")] == [0]


def test_listing_and_deleting_by_folder(store: BlobStore) -> None:
    for key in ("jobs/a/1/x", "jobs/a/manifest.json", "jobs/ab/1/x"):
        store.put(key, b".")
    assert list(store.list("jobs/a")) == ["jobs/a/1/x", "jobs/a/manifest.json"]
    store.delete_prefix("jobs/a")
    assert list(store.list("jobs")) == ["jobs/ab/1/x"]
    store.delete("jobs/ab/1/x")
    assert list(store.list("jobs")) == []


def test_large_blobs_are_written_and_read_in_parts(store: BlobStore) -> None:
    block = bytes(range(256)) * 4096
    with store.writer() as writer:
        for number in range(10):
            writer.write(block + bytes([number]))
        writer.commit("fields/f/original")
    whole = b"".join(block + bytes([number]) for number in range(10))
    assert [(entry.key, entry.bytes) for entry in store.entries("")] == [("fields/f/original", len(whole))]
    with store.open("fields/f/original") as file:
        assert file.read(10) == whole[:10]
        assert file.seek(-5, os.SEEK_END) == len(whole) - 5
        assert file.read(100) == whole[-5:]
        assert file.seek(len(block) - 3) == len(block) - 3
        assert file.read(8) == whole[len(block) - 3 : len(block) + 5]
        file.seek(0)
        assert file.read() == whole
    with store.local_copy("fields/f/original") as path:
        assert path.read_bytes() == whole


def test_a_large_blob_that_breaks_off_leaves_nothing(store: BlobStore) -> None:
    with pytest.raises(TypeError), store.writer() as writer:  # noqa: PT012
        writer.write(bytes(9 << 20))
        writer.write(b"broken off" + None)  # type: ignore[operator]
    assert list(store.list("")) == []
    assert store.sweep(0.0) == 0


def test_copies_of_fields_are_kept_until_the_field_changes(objects: ObjectServer, tmp_path: Path) -> None:
    cache = FileCache(tmp_path / "cache", 100)
    with environment(objects.environment):
        store = ObjectBlobStore(f"s3://{objects.new_bucket()}", cache=cache)
        for data in (b"first", b"first", b"another"):
            store.put("fields/f/field.safetensors", data)
            with store.local_copy("fields/f/field.safetensors") as path:
                assert path.read_bytes() == data
                assert path.parent == tmp_path / "cache"
        store.delete("fields/f/field.safetensors")
        with pytest.raises(FileNotFoundError), store.local_copy("fields/f/field.safetensors"):
            pass
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_an_object_that_is_replaced_while_it_is_read_is_told(objects: ObjectServer) -> None:
    with environment(objects.environment):
        store = ObjectBlobStore(f"s3://{objects.new_bucket()}")
        store.put("a", b"1" * (9 << 20))
        with store.open("a") as file:
            assert file.read(1) == b"1"
            store.put("a", b"2" * (9 << 20))
            file.seek(8 << 20)
            with pytest.raises(FileNotFoundError):
                file.read(1)


def test_a_store_that_is_away_is_told_after_some_patience(tmp_path: Path) -> None:
    with environment(
        {"AWS_ENDPOINT_URL": "http://127.0.0.1:1", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x"}
    ):
        store = ObjectBlobStore("s3://bucket", wait_s=0.2)
    for use in (store.probe, lambda: store.open("a"), lambda: store.put("a", b"."), lambda: list(store.list(""))):
        with pytest.raises(StorageUnavailableError):
            use()
    with pytest.raises(StorageUnavailableError), store.writer() as writer:  # noqa: PT012
        writer.write(bytes(20 << 20))
        writer.commit("a")


def test_a_store_that_takes_bytes_says_so(store: BlobStore) -> None:
    store.probe()
    assert list(store.list("")) == []


@pytest.mark.parametrize("key", BAD_KEYS)
def test_malformed_keys_are_refused_everywhere(store: BlobStore, key: str) -> None:
    for use in (store.open, store.exists, store.delete, lambda bad: store.put(bad, b".")):
        with pytest.raises(ValueError):
            use(key)
    with pytest.raises(ValueError), store.writer() as writer:
        writer.commit(key)
    assert list(store.list("")) == []


def test_links_out_of_the_store_are_refused(tmp_path: Path) -> None:
    store = LocalBlobStore(tmp_path / "blobs")
    (tmp_path / "secret").write_bytes(b"secret")
    (store.root / "file").symlink_to(tmp_path / "secret")
    (store.root / "folder").symlink_to(tmp_path)
    for key in ("file", "folder/secret"):
        for use in (store.open, store.exists, store.delete, lambda bad: store.put(bad, b".")):
            with pytest.raises(ValueError):
                use(key)
    assert (tmp_path / "secret").read_bytes() == b"secret"


def test_nothing_is_left_in_the_temporary_folder(tmp_path: Path) -> None:
    store = LocalBlobStore(tmp_path / "blobs")
    store.put("a", b".")
    store.put_if_absent("a", b"..")
    with store.writer() as writer:
        writer.write(b"aborted")
    with pytest.raises(ValueError), store.writer() as writer:
        writer.commit("../a")
    assert list(store.temporary.iterdir()) == []


def test_emptied_folders_go_too(tmp_path: Path) -> None:
    store = LocalBlobStore(tmp_path / "blobs")
    store.put("jobs/a/1/x", b".")
    store.delete("jobs/a/1/x")
    assert [path.name for path in store.root.iterdir()] == [".tmp"]


def _write_and_wait(root: Path, ready: "multiprocessing.synchronize.Event") -> None:
    with LocalBlobStore(root).writer() as writer:
        writer.write(b"half")
        ready.set()
        signal.pause()


def test_a_sweep_takes_the_leftovers_of_the_dead_and_of_nobody_else(tmp_path: Path) -> None:
    root = tmp_path / "blobs"
    store = LocalBlobStore(root)
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_write_and_wait, args=(root, ready))
    process.start()
    try:
        assert ready.wait(30)
        with store.writer() as living:
            living.write(b"alive")
            assert store.sweep() == 0
            assert process.pid is not None
            os.kill(process.pid, signal.SIGKILL)
            process.join()
            assert len(list(store.temporary.iterdir())) == 2
            assert LocalBlobStore(root).sweep() == 0, "opening the store has swept already"
            living.commit("a")
        assert list(store.temporary.iterdir()) == []
        assert list(store.list("")) == ["a"]
    finally:
        process.kill()
        process.join()


def test_a_full_disk_is_told_apart_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = LocalBlobStore(tmp_path / "blobs")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageFullError):
        store.put("a", b".")
    assert list(store.temporary.iterdir()) == []
    assert not store.exists("a")


@pytest.fixture
def away(tmp_path: Path) -> LocalBlobStore:
    """A store whose volume is gone: its mount point is left, empty."""
    store = LocalBlobStore(tmp_path / "blobs")
    store.put("jobs/a/manifest.json", b"kept")
    store.root.rename(tmp_path / "elsewhere")
    store.root.mkdir()
    return store


def test_a_folder_that_is_away_is_no_empty_folder(away: LocalBlobStore, tmp_path: Path) -> None:
    """Nothing is missing, nothing is listed, nothing is deleted, and nothing is written in its place."""
    key = "jobs/a/manifest.json"
    uses: list[Callable[[], object]] = [
        lambda: away.open(key),
        lambda: away.exists(key),
        lambda: list(away.list("jobs")),
        lambda: away.delete(key),
        lambda: away.delete_prefix("jobs"),
        lambda: away.put(key, b"."),
        lambda: away.put_if_absent(key, b"."),
        lambda: away.sweep(),
        away.probe,
    ]
    for use in uses:
        with pytest.raises(StorageUnavailableError):
            use()
    assert list(away.root.iterdir()) == []
    with pytest.raises(StorageUnavailableError):
        LocalBlobStore(away.root, existing=True).exists(key)
    assert list(away.root.iterdir()) == [], "whoever takes the store for existing makes none"
    away.root.rmdir()
    (tmp_path / "elsewhere").rename(away.root)
    assert list(away.list("")) == [key]


def test_a_folder_that_comes_back_in_time_was_never_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = LocalBlobStore(tmp_path / "blobs", wait_s=60.0)
    with store.writer() as writer:
        writer.write(b"half")
        store.root.rename(tmp_path / "elsewhere")
        waits: list[float] = []

        def come_back(seconds: float) -> None:
            waits.append(seconds)
            if len(waits) == 3:
                (tmp_path / "elsewhere").rename(store.root)

        monkeypatch.setattr("time.sleep", come_back)
        writer.commit("jobs/a/1/x")
    assert waits == [0.1, 0.2, 0.4]
    assert list(store.list("")) == ["jobs/a/1/x"]
    assert list(store.temporary.iterdir()) == []


def test_a_folder_that_cannot_be_read_makes_no_list_look_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LocalBlobStore(tmp_path / "blobs")
    store.put("jobs/a/x", b".")
    real = os.scandir

    def fail(path: str) -> object:
        if str(path).endswith("/a"):
            raise OSError(errno.EIO, "Input/output error")
        return real(path)

    monkeypatch.setattr(os, "scandir", fail)
    with pytest.raises(StorageUnavailableError):
        list(store.list(""))
