"""An engine that does in milliseconds what the label of a request's detection names: succeed, refuse, hang, die ..."""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import signal
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from redis.exceptions import RedisError

from regnf_core.errors import NoSurfaceError
from regnf_core.library_entries import EntryNotes
from regnf_core.rendering.request import RenderRequest
from regnf_state.blobs.local import LocalBlobStore
from regnf_state.manifest import EDITED_FIELD
from regnf_state.registration_request import RegistrationRequest
from regnf_state.settings import Settings
from regnf_worker.attempt import run_attempt
from regnf_worker.engine import Candidate, Engine, Made
from regnf_worker.models import Context

Report = Callable[[str, float], None]


class TinyEngine(Engine):
    """The label is a method's name."""

    def __init__(self, attempt: int = 1) -> None:
        super().__init__("cpu")
        object.__setattr__(self, "attempt", attempt)

    def describe(self) -> dict[str, Any]:
        return {"version": "tiny", "device": "none"}

    def register(
        self,
        scene: Path,
        object_: Path,
        model: Any,
        request: RegistrationRequest,
        report: Report,
        folder: Path,
        notes: Any,
    ) -> Made:
        report("sampling", 0.1)
        (folder / "half-written").write_bytes(b".")
        getattr(self, request.detection.label or "")(report)
        report("exporting", 0.9)
        (folder / "result.json").write_text(json.dumps({"pid": os.getpid()}))
        (folder / "aligned.ply").write_bytes(scene.read_bytes() + object_.read_bytes())
        names = ["result.json", "aligned.ply"]
        if request.detection.label == "draw_for_ever":
            return Made(names, ["preview.png"], lambda: self.iterate(lambda *_: None) or [])  # type: ignore[func-returns-value]
        return Made(names)

    def search(
        self,
        scene: Path,
        candidates: Sequence[Candidate],
        request: RegistrationRequest,
        report: Report,
        folder: Path,
        notes: Any,
    ) -> Made:
        """Finds the first; its picture, where one is wanted, is made of the candidates' own bytes."""
        getattr(self, request.detection.label or "")(report)
        (folder / "result.json").write_text(json.dumps({"object": candidates[0].sha256}))

        def finish() -> list[str]:
            (folder / "preview.png").write_bytes(b"".join(one.open().read_bytes() for one in candidates))
            return ["preview.png"]

        return Made(["result.json"], ["preview.png"], finish) if request.pictures else Made(["result.json"])

    def render(
        self,
        scene: Path,
        objects: Mapping[str, Callable[[], Path]],
        request: RenderRequest,
        report: Report,
        folder: Path,
    ) -> list[str]:
        """A picture of what was opened; the edited scene as the scene's own bytes. An edit's name is a method's."""
        report("composing", 0.1)
        (folder / "frame-0000.png").write_bytes(b"half")
        for edit in request.edits:
            getattr(self, edit.name or "succeed")(report)
        opened = b"".join(objects[name]().read_bytes() for name in sorted(objects))
        (folder / "frame-0000.png").write_bytes(scene.read_bytes() + opened)
        (folder / "result.json").write_text(json.dumps({"frames": 1}))
        if "field" not in request.outputs:
            return ["frame-0000.png", "result.json"]
        (folder / EDITED_FIELD).write_bytes(scene.read_bytes())
        return ["frame-0000.png", EDITED_FIELD, "result.json"]

    def make_model(self, field: Path, options: Any, target: Path) -> None:
        target.write_bytes(field.read_bytes())

    def read_model(self, path: Path) -> bytes:
        return path.read_bytes()

    def symmetry(self, model: bytes) -> dict[str, Any]:
        return {"order": 1, "axis": None, "continuous": False}

    def succeed(self, report: Report) -> None:
        report("optimizing", 0.5)

    draw_for_ever = succeed

    def refuse(self, report: Report) -> None:
        raise NoSurfaceError("nothing in the box")

    def crash(self, report: Report) -> None:
        raise ZeroDivisionError("secret value 42")

    def die_while_writing(self, report: Report) -> None:
        writer = LocalBlobStore(Settings().blob_dir, existing=True).writer()
        writer.write(b"half")
        os.kill(os.getpid(), signal.SIGKILL)

    def exhaust(self, report: Report) -> None:
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes")

    def fill_memory(self, report: Report) -> None:
        """Memory of its own, until it gets no more."""
        held = []
        while True:
            held.append(bytearray(16 << 20))

    def fill_shared_memory(self, report: Report) -> None:
        """Memory that the kernel does not count as the process' data."""
        held = []
        while True:
            held.append(mmap.mmap(-1, 16 << 20))
            held[-1].write(b"." * (16 << 20))
            time.sleep(0.01)

    def fill_memory_and_abort(self, report: Report) -> None:
        """What native code does: it catches no std::bad_alloc, and aborts."""
        held = []
        with suppress(MemoryError):
            while True:
                held.append(bytearray(16 << 20))
        os.abort()

    def lose_redis_near_the_limit(self, report: Report) -> None:
        """The first time Redis goes away when most of the memory is in use."""
        held = bytearray(b".") * (440 << 20)
        if self.attempt == 1:
            raise RedisError(f"with {len(held)} bytes in use")

    def abort(self, report: Report) -> None:
        os.abort()

    def fill_disk(self, report: Report) -> None:
        """Temporary files, one after the other."""
        for number in count():
            Path(tempfile.gettempdir(), f"{number}").write_bytes(b"." * (8 << 20))
            time.sleep(0.01)

    def write_one_large_file(self, report: Report) -> None:
        """A file beyond the limit of a single one; it has no content, and takes no space."""
        with Path(tempfile.gettempdir(), "large").open("wb") as file:
            file.truncate(1 << 40)

    def iterate(self, report: Report) -> None:
        """Goes on until it is stopped, reporting all the while."""
        while True:
            report("optimizing", 0.5)
            time.sleep(0.01)

    def wait_for_file(self, report: Report) -> None:
        """Goes on once the file `go` is in the state folder."""
        while not (Settings().state_dir / "go").exists():
            time.sleep(0.01)

    def refuse_after_file(self, report: Report) -> None:
        self.wait_for_file(report)
        self.refuse(report)

    def hang(self, report: Report) -> None:
        """Native code that never comes back to Python: no alarm is heard, nothing is reported."""
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
        ctypes.CDLL(None).sleep(600)

    def segfault(self, report: Report) -> None:
        signal.signal(signal.SIGSEGV, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGSEGV)

    def leave(self, report: Report) -> None:
        """Ends by itself without a word, the first time."""
        if self.attempt == 1:
            os._exit(0)


def run_registration(job_id: str, attempt: int, worker: str) -> None:
    """What tests' workers run instead of regnf_worker.jobs.run_registration."""
    run_attempt(Context.from_settings(Settings()), job_id, attempt, worker, lambda: TinyEngine(attempt))


def run_import(sha256: str, attempt: int, worker: str) -> None:
    """An import whose upload says how it ends: "object" and "air" become entries before the process has ended."""
    from regnf_worker.imports import run_import_attempt

    context = Context.from_settings(Settings())
    with (Settings().state_dir / "imports").open("a") as file:
        file.write(f"{sha256}\n")
    begun = context.records.get_field(sha256)
    run_import_attempt(context, sha256, attempt, worker, tiny_importer)
    field = context.records.get_field(sha256)
    if begun is None or field is None or field.state != "ready":
        return
    with context.blobs.open(f"fields/{sha256}/field.safetensors") as file:
        kind = file.read()
    if begun.library is not None and kind == b"object":
        symmetry = {"order": 1, "axis": None, "continuous": False}
        context.records.update_field(sha256, attempt=attempt, symmetry=symmetry)
    elif begun.library is None and kind in (b"object", b"air"):
        context.records.set_entry(field, EntryNotes.checked("an entry"))
        context.queue.enqueue_import(sha256, attempt)


def tiny_importer(
    upload: Path, folder: Path, description: dict[str, Any], settings: Path | None, cameras: Path | None = None
) -> dict[str, Any]:
    if upload.read_bytes() == b"die":
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / "field.safetensors").write_bytes(upload.read_bytes())
    return {"family": "tiny"}


def run_drawing(reference: str) -> None:
    """Says that it has begun, and goes on once the file `draw` is in the state folder."""
    from regnf_core.field_notes import FieldViews
    from regnf_worker.jobs import draw_field

    def draw(path: Path) -> FieldViews:
        folder = Settings().state_dir
        (folder / "drawing").touch()
        while not (folder / "draw").exists():
            time.sleep(0.01)
        return FieldViews(path.read_bytes())

    draw_field(Context.from_settings(Settings()), reference, draw)
