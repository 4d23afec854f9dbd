"""Meshes and pictures of fields: made once a field is ready, in time that is left, and gone with their field."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_core.errors import NoSurfaceError
from regnf_core.field_notes import FieldViews
from regnf_state.records import FieldRecord
from regnf_worker.jobs import draw_field
from regnf_worker.models import Context
from tests.processes import alive, children_of
from tests.worker.bench import OBJECT, SCENE, Bench, bench, eventually, kill
from tests.worker.doubles import SHA, begin_import, field

VIEWS = FieldViews(b"fine", None, b"picture")
KEYS = [f"fields/{SHA}/field.safetensors", f"fields/{SHA}/mesh.glb", f"fields/{SHA}/preview.png"]


@pytest.fixture
def undrawn(context: Context) -> Context:
    """The stores with a ready field that nobody has drawn."""
    begin_import(context)
    context.blobs.delete(f"fields/{SHA}/original")
    context.blobs.put(f"fields/{SHA}/field.safetensors", b"f")
    context.records.update_field(SHA, state="ready", views="pending")
    return context


def test_a_field_is_drawn_once(undrawn: Context) -> None:
    assert undrawn.records.undrawn_fields() == [SHA]
    draw_field(undrawn, SHA, lambda path: FieldViews(path.read_bytes(), None, b"picture"))
    assert (field(undrawn).views, field(undrawn).drawings) == ("ready", 1)
    assert list(undrawn.blobs.list("")) == KEYS
    with undrawn.blobs.open(f"fields/{SHA}/mesh.glb") as file:
        assert file.read() == b"f"
    assert undrawn.records.undrawn_fields() == []
    draw_field(undrawn, SHA, refused)
    assert field(undrawn).views == "ready"


def refused(_: Path) -> FieldViews:
    raise NoSurfaceError("nothing to see")


@pytest.mark.parametrize("draw", [refused, lambda _: FieldViews()])
def test_a_field_that_cannot_be_drawn_is_not_tried_again(undrawn: Context, draw: object) -> None:
    draw_field(undrawn, SHA, draw)  # type: ignore[arg-type]
    assert field(undrawn).views == "none"
    assert undrawn.records.undrawn_fields() == []
    assert list(undrawn.blobs.list("")) == KEYS[:1]


def test_a_drawing_that_kills_its_process_is_given_up(undrawn: Context) -> None:
    def dies(_: Path) -> FieldViews:
        raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            draw_field(undrawn, SHA, dies)
    assert field(undrawn).views == "pending"
    draw_field(undrawn, SHA, dies)
    assert field(undrawn).views == "none"


@pytest.mark.parametrize("opened", [True, False])
def test_a_field_deleted_while_it_is_drawn_leaves_nothing(undrawn: Context, opened: bool) -> None:
    def deletes(path: Path) -> FieldViews:
        undrawn.records.delete_field(SHA)
        undrawn.blobs.delete_prefix(f"fields/{SHA}")
        return VIEWS if opened else FieldViews(path.read_bytes())

    draw_field(undrawn, SHA, deletes)
    assert list(undrawn.blobs.list("")) == []
    assert undrawn.records.undrawn_fields() == []


def test_a_field_whose_file_alone_is_lost_is_a_fault(undrawn: Context) -> None:
    undrawn.blobs.delete(f"fields/{SHA}/field.safetensors")
    with pytest.raises(FileNotFoundError):
        draw_field(undrawn, SHA, lambda path: FieldViews(path.read_bytes()))


def test_a_field_imported_anew_keeps_nothing_of_the_drawing_before(undrawn: Context) -> None:
    def reimports(_: Path) -> FieldViews:
        undrawn.records.reimport_field(field(undrawn), {"sign": -1}, None)
        return VIEWS

    draw_field(undrawn, SHA, reimports)
    assert field(undrawn).state == "validating"
    assert list(undrawn.blobs.list("")) == KEYS[:1]


def test_of_undrawn_fields_the_one_asked_for_last_is_first(undrawn: Context) -> None:
    now = undrawn.records.now()
    other = "b" * 64
    undrawn.records.create_field(FieldRecord(other, "validating", 1, now, now))
    undrawn.records.update_field(other, state="ready", views="pending")
    assert undrawn.records.undrawn_fields() == [other, SHA]
    undrawn.records.draw_next(SHA)
    assert undrawn.records.undrawn_fields() == [SHA, other]
    undrawn.records.draw_next("c" * 64)
    assert undrawn.records.undrawn_fields() == [SHA, other]


# with worker processes: a file `draw` in the state folder lets their drawings end


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, shutdown_grace_s=0) as made:
        made.add_ready_fields()
        yield made


def upload(table: Bench) -> None:
    now = table.context.records.now()
    table.context.blobs.put(f"fields/{SHA2}/original", b"f")
    record, _ = table.context.records.create_field(FieldRecord(SHA2, "validating", 1, now, now))
    table.context.queue.enqueue_import(SHA2, record.attempt)


SHA2 = "c" * 64


def views(table: Bench) -> tuple[str | None, int]:
    record = table.context.records.get_field(SHA2)
    assert record is not None
    return record.views, record.drawings


def begun(table: Bench) -> bool:
    return (table.context.settings.state_dir / "drawing").exists()


def test_jobs_run_while_a_field_is_drawn(table: Bench) -> None:
    worker = table.start_worker()
    upload(table)
    eventually(lambda: begun(table), table.log)
    assert views(table) == ("pending", 1)
    (drawing,) = children_of(worker.pid)
    table.submit("succeed")
    assert table.finished().status == "successful"
    assert alive(drawing)
    (table.context.settings.state_dir / "draw").touch()
    eventually(lambda: views(table)[0] == "ready", table.log)
    eventually(lambda: not children_of(worker.pid), "no zombie")


def test_a_drawing_gives_way_to_jobs(table: Bench) -> None:
    worker = table.start_worker()
    upload(table)
    eventually(lambda: begun(table), table.log)
    (drawing,) = children_of(worker.pid)
    own = os.getpriority(os.PRIO_PROCESS, worker.pid)
    assert os.getpriority(os.PRIO_PROCESS, drawing) == own + 3


def test_a_drawing_ends_with_its_worker_and_another_one_draws(table: Bench) -> None:
    for number, end in enumerate((signal.SIGKILL, signal.SIGTERM), 1):
        worker = table.start_worker()
        if number == 1:
            upload(table)
        eventually(lambda: begun(table), table.log)
        (drawing,) = children_of(worker.pid)
        kill(worker.pid, end)
        worker.wait()
        eventually(lambda child=drawing: not alive(child), "the drawing's end")
        assert views(table) == ("pending", number)
        (table.context.settings.state_dir / "drawing").unlink()
    (table.context.settings.state_dir / "draw").touch()
    table.start_worker()
    eventually(lambda: views(table) == ("ready", 3), table.log)


def test_one_field_is_drawn_at_a_time(table: Bench) -> None:
    for _ in range(2):
        table.start_worker()
    upload(table)
    eventually(lambda: begun(table), table.log)
    for reference in (SCENE, OBJECT):
        table.context.records.update_field(reference, views="pending")
    for name in ("j1", "j2"):
        table.submit("succeed", name)
        assert table.finished(name).status == "successful"
    found = table.context.records.get_fields([SCENE, OBJECT, SHA2])
    assert sum(one.drawings for one in found if one is not None) == 1
    (table.context.settings.state_dir / "draw").touch()
    eventually(lambda: not table.context.records.undrawn_fields(), table.log)
