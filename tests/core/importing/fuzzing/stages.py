"""The gate's stages, run in this process on one case, and watched: what they import, open or start is an event."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.legacy_container import read_archive
from regnf_core.importing.containers.safetensors_header import read_header
from regnf_core.importing.families import convert_checkpoint
from regnf_core.importing.gate import convert
from regnf_core.importing.gate.cost_estimate import require_affordable
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits, placed
from regnf_core.importing.pickle.pickle_reader import read_pickle
from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.settings.facts import Facts
from regnf_core.importing.settings.translate import merged, translate_settings
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.safe_format import write_safe_field

BUDGET = 1 << 24
"""Bytes of tensors that one case may have."""
PARTS = ("container", "pickle", "tensors", "header", "settings")
"""The stages that see a part of the gate; all others begin with a whole file."""
_TAKEN = "taken"
_LIMITS = ImportLimits(wall_s=100, tensor_bytes=BUDGET)
_QUIET = (
    *("object.", "sys._getframe", "code.__new__", "builtins.id", "gc.", "tempfile.", "time.", "sys.", "mmap."),
    "sqlite3.",
)
"""Beginnings of the audit events that mean nothing here."""


_LITERAL = "<unknown>"
"""The name under which ``ast.literal_eval`` parses. numpy reads the headers of arrays so: a syntax tree is made of the
text, but no code; running any would be the event "exec"."""


class Watch:
    """Collects the audit events of a case: an import, a program, a socket ... that a file has brought about."""

    def __init__(self) -> None:
        self._armed = False
        self._files = False
        self._stage = ""
        self.events: list[str] = []
        sys.addaudithook(self._hear)

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self._armed or event.startswith(_QUIET) or (self._files and event in ("open", "os.remove", "os.rename")):
            return
        if self._stage in ("arrays", "run") and event == "compile" and args[1] == _LITERAL:
            return
        self.events.append(f"{event} {args!r:.200}")

    @contextmanager
    def over(self, stage: str) -> Iterator[None]:
        """Watch one case."""
        self._armed, self._files, self._stage = True, stage not in PARTS, stage
        try:
            yield
        finally:
            self._armed = False


def run_stage(stage: str, data: bytes, folder: Path) -> str:
    """The reason of the refusal, or "taken". Any other exception passes through. ``folder`` is for whole files."""
    try:
        match stage:
            case "container":
                archive = read_archive(memoryview(data))
                for name in archive.entries:
                    archive.read(name)
            case "pickle":
                read_pickle(memoryview(data))
            case "tensors":
                _tensors(data)
            case "header":
                read_header(memoryview(data))
            case "settings":
                _settings(data)
            case _:
                _file(data, folder)
    except FieldFormatError as error:
        return error.reason
    return _TAKEN


def _tensors(data: bytes) -> None:
    archive = read_archive(memoryview(data))
    value = read_pickle(archive.read("data.pkl"))
    state = value.get("pipeline", value) if isinstance(value, dict) else {"value": value}
    members = list(state.items()) if isinstance(state, dict) else [("state", state)]
    for key, found in members[:100]:  # whatever they are
        with suppress(FieldFormatError):
            TensorSource(archive, BUDGET).array(key if isinstance(key, str) else "odd", found)
    convert_checkpoint(value, TensorSource(archive, BUDGET), UploadDescription())


def _settings(data: bytes) -> None:
    """A file of settings behind a line with its name."""
    name, _, content = data.partition(b"\n")
    file = SettingsFile(name.decode("latin-1"), memoryview(content))
    facts = Facts({"step": 60_000, "global_step": 5000, "iteration": 20_000})
    settings = translate_settings((file,), facts, UploadDescription(), required=False)
    UploadDescription.from_dict(merged({"hash": {"levels": 4}, "world_scale": 2.0}, settings.values))
    json.dumps(settings.report(), allow_nan=False)


def _file(data: bytes, folder: Path) -> None:
    upload, out = folder / "upload", folder / "out"
    upload.write_bytes(data)
    try:
        read = convert._read(upload, folder, None, _LIMITS, Companions())
        converted, said = read.field, read.description
        converted = placed(converted, said)
        convert._require_text(converted.description)
        require_affordable(converted, _LIMITS)
        write_safe_field(out, converted.description, converted.tensors)
    finally:
        upload.unlink()
        out.unlink(missing_ok=True)
