"""Copies on this machine: fetched once, kept below a size, never taken from under a reader."""

import multiprocessing
import os
import signal
import threading
from pathlib import Path
from typing import BinaryIO

import pytest

from regnf_state.blobs.base import FileCache


class Source:
    """Bytes from elsewhere; ``fetched`` counts how often they were asked for."""

    def __init__(self, data: bytes = b"0123456789") -> None:
        self.data = data
        self.fetched = 0

    def __call__(self, target: BinaryIO) -> None:
        self.fetched += 1
        target.write(self.data)


def sizes(folder: Path) -> list[int]:
    return sorted(path.stat().st_size for path in folder.iterdir())


def use(cache: FileCache, name: str, source: Source) -> bytes:
    with cache.held(name, source) as path:
        return path.read_bytes()


def age(folder: Path, seconds: int) -> None:
    """Everything there was last used this long before."""
    for path in folder.iterdir():
        status = path.stat()
        os.utime(path, (status.st_atime - seconds, status.st_mtime - seconds))


def test_a_file_is_fetched_once(tmp_path: Path) -> None:
    cache, source = FileCache(tmp_path, 100), Source()
    assert use(cache, "a", source) == source.data
    assert use(FileCache(tmp_path, 100), "a", source) == source.data
    assert source.fetched == 1


def test_the_least_recently_used_go_first(tmp_path: Path) -> None:
    cache, sources = FileCache(tmp_path, 25), {name: Source() for name in "abc"}
    for name in "ab":
        use(cache, name, sources[name])
        age(tmp_path, 10)
    use(cache, "a", sources["a"])
    use(cache, "c", sources["c"])
    assert sizes(tmp_path) == [10, 10]
    use(cache, "a", sources["a"])
    assert sources["a"].fetched == 1
    use(cache, "b", sources["b"])
    assert sources["b"].fetched == 2


def test_a_file_in_use_stays_though_there_is_no_room(tmp_path: Path) -> None:
    cache, source = FileCache(tmp_path, 0), Source()
    with cache.held("a", source) as path:
        age(tmp_path, 10)
        use(cache, "b", Source())
        with cache.held("c", Source()) as other:
            assert path.read_bytes() == other.read_bytes() == source.data
    use(cache, "d", Source())
    assert len(list(tmp_path.iterdir())) == 1, "those that nobody holds any more went"


def test_a_fetch_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail(target: BinaryIO) -> None:
        target.write(b"half")
        raise FileNotFoundError("gone")

    with pytest.raises(FileNotFoundError), FileCache(tmp_path, 100).held("a", fail):
        pass
    assert list(tmp_path.iterdir()) == []


def test_several_fetch_the_same_at_once(tmp_path: Path) -> None:
    cache, barrier = FileCache(tmp_path, 0), threading.Barrier(4)
    seen: list[bytes] = []

    def fetch(target: BinaryIO) -> None:
        barrier.wait(20)
        target.write(b"0123456789")

    def hold() -> None:
        with cache.held("a", fetch) as path:
            barrier.wait(20)
            seen.append(path.read_bytes())

    threads = [threading.Thread(target=hold) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [b"0123456789"] * 4
    assert sizes(tmp_path) == [10]


def _fetch_and_wait(folder: Path, ready: "multiprocessing.synchronize.Event") -> None:
    def fetch(target: BinaryIO) -> None:
        target.write(b"half")
        target.flush()
        ready.set()
        signal.pause()

    with FileCache(folder, 100).held("a", fetch):
        pass


def test_what_a_killed_process_was_fetching_goes_with_the_next_use(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_fetch_and_wait, args=(tmp_path, ready))
    process.start()
    try:
        assert ready.wait(30)
        use(FileCache(tmp_path, 100), "b", Source())
        assert len(list(tmp_path.iterdir())) == 2, "it is still at it"
    finally:
        process.kill()
        process.join()
    assert use(FileCache(tmp_path, 100), "a", Source()) == b"0123456789"
    assert sizes(tmp_path) == [10, 10]
