"""What follows a published result: pictures and clouds, or word that they are missing. The result stands anyway."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from regnf_state.manifest import Manifest, Rest, read_manifest
from regnf_worker.artifacts import publish
from regnf_worker.attempt import run_attempt
from regnf_worker.engine import Made
from regnf_worker.models import Context
from regnf_worker.pictures import publish_rest
from regnf_worker.settle import ChildExit, settle_registration
from tests.processes import alive, children_of
from tests.worker.bench import Bench, bench, eventually, kill
from tests.worker.doubles import accept, job
from tests.worker.tiny_engine import TinyEngine

TO_COME = ("preview.png", "context_points.ply")


class Drawing(TinyEngine):
    """Leaves pictures to be made by ``draw``, which tests replace."""

    def register(self, *given: Any) -> Made:
        made, folder = super().register(*given), given[5]

        def finish() -> Sequence[str]:
            self.draw()
            (folder / "preview.png").write_bytes(b"a picture")
            return ["preview.png"]

        return replace(made, to_come=TO_COME, finish=finish)

    def draw(self) -> None:
        pass


def manifest_of(context: Context) -> Manifest:
    manifest = read_manifest(context.blobs, "j1")
    assert manifest is not None
    return manifest


def listed(manifest: Manifest) -> list[str]:
    return [one.name for one in manifest.artifacts]


def test_the_result_is_out_before_its_pictures(context: Context) -> None:
    accept(context)
    seen: list[Any] = []

    class Looking(Drawing):
        def draw(self) -> None:
            manifest = manifest_of(context)
            seen.append((job(context).status, listed(manifest), manifest.pending))

    run_attempt(context, "j1", 1, "w", Looking)
    assert seen == [("successful", ["result.json", "aligned.ply"], TO_COME)]
    done = manifest_of(context)
    assert (listed(done), done.pending, done.missing) == (["result.json", "aligned.ply", "preview.png"], (), ())
    with context.blobs.open(done.key("preview.png")) as file:
        assert file.read() == b"a picture"
    assert job(context).status == "successful"


@pytest.mark.parametrize("error", [ValueError("no picture"), MemoryError()])
def test_pictures_that_fail_are_missing(context: Context, error: Exception) -> None:
    class Failing(Drawing):
        def draw(self) -> None:
            raise error

    accept(context)
    run_attempt(context, "j1", 1, "w", Failing)
    done = manifest_of(context)
    assert (job(context).status, listed(done)) == ("successful", ["result.json", "aligned.ply"])
    assert (done.pending, done.missing) == ((), TO_COME)


def test_a_job_deleted_while_its_pictures_are_made_leaves_nothing(context: Context) -> None:
    class Deleting(Drawing):
        def draw(self) -> None:
            context.records.delete_job("j1")
            context.blobs.delete_prefix("jobs/j1")

    accept(context)
    run_attempt(context, "j1", 1, "w", Deleting)
    assert list(context.blobs.list("jobs")) == []


def test_a_process_that_dies_between_result_and_pictures(context: Context) -> None:
    class Dying(Drawing):
        def draw(self) -> None:
            raise KeyboardInterrupt

    accept(context)
    with pytest.raises(KeyboardInterrupt):
        run_attempt(context, "j1", 1, "w", Dying)
    settle_registration(context, "j1", 1, "w", ChildExit(signal=9))
    done = manifest_of(context)
    assert (job(context).status, done.pending, done.missing) == ("successful", (), TO_COME)


def test_a_result_whose_process_died_before_its_record_ended(context: Context) -> None:
    accept(context)
    context.records.update_job("j1", 1, status="running", worker="w")
    publish(context.blobs, Manifest("j1", 1, (), TO_COME))
    settle_registration(context, "j1", 1, "w", ChildExit(signal=9))
    assert (job(context).status, manifest_of(context).missing) == ("successful", TO_COME)


def test_the_attempt_after_it_says_what_is_missing(context: Context) -> None:
    accept(context)
    publish(context.blobs, Manifest("j1", 7, (), TO_COME))
    run_attempt(context, "j1", 1, "w", Drawing)
    assert (job(context).status, manifest_of(context).missing) == ("successful", TO_COME)


def test_what_came_of_the_rest_is_said_once(context: Context) -> None:
    class Slow(Drawing):
        def draw(self) -> None:
            publish_rest(context.blobs, "j1", Rest(missing=TO_COME))

    accept(context)
    run_attempt(context, "j1", 1, "w", Slow)
    assert manifest_of(context).missing == TO_COME
    assert "jobs/j1/1/preview.png" not in list(context.blobs.list("jobs"))


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, shutdown_grace_s=0) as made:
        made.add_ready_fields()
        yield made


@pytest.mark.parametrize("killed", ["job", "worker"])
def test_a_result_stands_whoever_dies_after_it(table: Bench, killed: str) -> None:
    worker = table.start_worker()
    table.submit("draw_for_ever")
    assert table.finished().status == "successful"
    if killed == "worker":
        worker.kill()
        worker.wait()
        assert manifest_of(table.context).pending == ("preview.png",), "the front end says that it is missing, in time"
        return
    (child,) = children_of(worker.pid)
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful", "the worker goes on beside the pictures"
    assert alive(child)
    kill(child, signal.SIGKILL)
    eventually(lambda: manifest_of(table.context).missing == ("preview.png",), table.log)
    eventually(lambda: not table.leftovers(), "a clean scratch folder")


def test_pictures_that_take_too_long_are_given_up(table: Bench) -> None:
    table.start_worker(lost_after_s=1)
    table.submit("draw_for_ever")
    table.finished()
    eventually(lambda: manifest_of(table.context).missing == ("preview.png",), table.log)
    assert table.job().status == "successful"


def test_one_job_at_most_is_left_behind(table: Bench) -> None:
    """The second process with pictures to make waits for the first one, and its worker waits with it."""
    worker = table.start_worker(lost_after_s=3)
    for name in ("j1", "j2", "j3"):
        table.submit("draw_for_ever", name)
    eventually(lambda: table.job("j3").status == "successful", table.log)
    assert len(children_of(worker.pid)) <= 2
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(30) == 0
    for name in ("j1", "j2", "j3"):
        manifest = read_manifest(table.context.blobs, name)
        assert manifest is not None
        assert manifest.missing == ("preview.png",)
    assert [path for path in table.context.settings.scratch_dir.iterdir() if path.is_dir()] == []
