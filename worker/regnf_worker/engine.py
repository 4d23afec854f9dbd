"""Where the worker meets regnf_core: files in, files out. torch is loaded by the methods, in a job's own process."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from regnf_core import __version__
from regnf_core.field_notes import NO_NOTES, FieldNotes
from regnf_core.importing.gate.gate import ImportLimits, import_field
from regnf_core.library_folder import digest_of
from regnf_core.options import RegistrationOptions
from regnf_core.rendering.request import RenderRequest
from regnf_core.version import ENGINE_REVISION
from regnf_state.manifest import EDITED_FIELD
from regnf_state.records import RECORDING
from regnf_state.registration_request import RegistrationRequest
from regnf_worker.recorded import place_of

if TYPE_CHECKING:
    from regnf_core.rendering.job import RenderReport


Report = Callable[[str, float], None]
Importer = Callable[[Path, Path, dict[str, Any], Path | None, Path | None], dict[str, Any]]
"""(upload, folder, description, settings, cameras) -> report; writes folder/field.safetensors.

Raises FieldFormatError."""


@dataclass(frozen=True)
class Made:
    """What the engine has written of a result, by name, and what it has yet to write when ``finish`` is called.

    ``finish`` returns the names of what it wrote: ``to_come`` or fewer. ``on_request``: what can be drawn of all that.
    """

    names: Sequence[str]
    to_come: Sequence[str] = ()
    finish: Callable[[], Sequence[str]] = tuple
    on_request: Sequence[str] = ()


Notes = Mapping[str, FieldNotes]
"""What is known of the fields' imports: of `scene`, and of each object by its SHA-256."""
Model = Any
"""An object's model, of whatever kind the engine makes: only the engine looks inside."""


@dataclass(frozen=True)
class Candidate:
    """One object of a search: its field's SHA-256, what opens the regnf field file, and its model.

    An object without a model is unusable, for ``fault``, a reason.
    """

    sha256: str
    open: Callable[[], Path]
    model: Model | None
    fault: str | None = None


@dataclass(frozen=True)
class Engine:
    """Registers and renders regnf field files on one device. Everything may raise RegnfError."""

    device: str

    @classmethod
    def on(cls, choice: Literal["auto", "cpu", "cuda"], sharing: int = 1) -> Engine:
        """``auto``: the GPU if torch can use one, else the CPU. Of a GPU's memory this process may use the part that is
        left to each of ``sharing`` processes; beyond that torch raises OutOfMemoryError."""
        import torch

        device = ("cuda" if torch.cuda.is_available() else "cpu") if choice == "auto" else choice
        if device == "cuda" and sharing > 1:
            torch.cuda.set_per_process_memory_fraction(1.0 / sharing)
        return cls(device)

    def describe(self) -> dict[str, Any]:
        """Version and device, for the job's record."""
        return {"version": __version__, "revision": ENGINE_REVISION, "device": self.device}

    def register(
        self,
        scene: Path,
        object_: Path,
        model: Model | None,
        request: RegistrationRequest,
        report: Report,
        folder: Path,
        notes: Notes,
    ) -> Made:
        """Do what a request asks for, artifacts into ``folder``. ``model`` saves making one."""
        from regnf_core.fields.build import open_field
        from regnf_core.geometry.sim3 import Sim3
        from regnf_core.library import register, with_late_clouds
        from regnf_core.viewing.artifacts import CLOUDS, PICTURE, write_clouds, write_result

        _one_thread()
        start, truth = request.initial_transform, request.ground_truth
        thing = open_field(object_, self.device)
        place = place_of(scene, request, model or thing, self.device)
        fields, box, options = (place.field, thing), place.box, place.options
        initial = Sim3.from_matrix(start) if start else None
        # errors against a truth are those of the clouds' points
        result = place.seen(register(*fields, box, options, request.seed, report, initial, model, bool(truth)))
        T_true = Sim3.from_matrix(truth) if truth else None
        said: dict[str, Any] = {"object_name": request.object, "fields": _fields(notes, request.object, place.notes)}
        names = write_result(result, folder, truth=T_true, **said)

        def finish() -> list[str]:
            shown = result if truth else with_late_clouds(result, *fields, box, options)
            return [*place.draw(result, thing, folder), *write_clouds(shown, folder)]

        return Made(names, (*place.pictures, *CLOUDS), finish, (PICTURE,)) if request.pictures else Made(names)

    def search(
        self,
        scene: Path,
        candidates: Sequence[Candidate],
        request: RegistrationRequest,
        report: Report,
        folder: Path,
        notes: Notes,
    ) -> Made:
        """The same for a request with candidates."""
        from regnf_core.document import ranking_document
        from regnf_core.fields.build import open_field
        from regnf_core.library import LibraryObject, search_library, with_late_clouds
        from regnf_core.viewing.artifacts import CLOUDS, PICTURE, write_clouds, write_result
        from regnf_core.viewing.difference_panel import DIFFERENCE

        _one_thread()

        def opener(one: Candidate) -> Callable[[], Any]:
            return lambda: open_field(one.open(), self.device)

        unusable = {one.sha256: one.fault for one in candidates if one.fault is not None}
        place = place_of(scene, request, None, self.device)
        box, options = place.box, place.options
        objects = {
            one.sha256: LibraryObject(one.sha256, opener(one), one.model) for one in candidates if one.model is not None
        }
        found = search_library(place.field, box, [*objects.values()], options, request.seed, report, clouds=False)
        result = place.seen(found.result)
        winner, ranking = found.ranking[0].name, ranking_document(found.ranking, unusable)
        said: dict[str, Any] = {
            "object_name": winner,
            "candidates": ranking,
            "fields": _fields(notes, winner, place.notes),
        }
        names = write_result(result, folder, **said)

        def finish() -> list[str]:
            thing = objects[winner].field()
            shown = with_late_clouds(result, place.field, thing, box, options)
            return [*place.draw(result, thing, folder), *write_clouds(shown, folder)]

        clouds = CLOUDS if result.deciding is None else (*CLOUDS, DIFFERENCE)
        return Made(names, (*place.pictures, *clouds), finish, (PICTURE,)) if request.pictures else Made(names)

    def render(
        self,
        scene: Path,
        objects: Mapping[str, Callable[[], Path]],
        request: RenderRequest,
        report: Report,
        folder: Path,
    ) -> list[str]:
        """The same for a rendering. objects: what opens the regnf field file of each object that edits name."""
        import torch

        from regnf_core.fields.build import open_field
        from regnf_core.rendering.job import phase_of, run_render

        made = run_render(
            open_field(scene, self.device),
            request,
            lambda name: open_field(objects[name](), self.device),
            folder,
            lambda share: report(phase_of(share), share),
            processes=torch.get_num_threads(),
        )
        return write_result(folder, request, made, self.describe())

    def make_model(self, field: Path, options: RegistrationOptions, target: Path) -> None:
        """Write the model of a regnf field file as an object."""
        from regnf_core.fields.build import open_field
        from regnf_core.library import model_object, write_object_model

        write_object_model(target, model_object(open_field(field, self.device), options.robust))

    def read_model(self, path: Path) -> Model:
        """A model that ``make_model`` wrote."""
        from regnf_core.library import read_object_model

        return read_object_model(path)

    def symmetry(self, model: Model) -> dict[str, Any]:
        """The object's symmetry as the contract shows it."""
        return asdict(model.symmetry.group())


def _one_thread() -> None:
    """Of torch for this job: to wake a second one takes longer than its operations (docs/capacity.md)."""
    import torch

    torch.set_num_threads(1)


def _fields(notes: Notes, obj: str | None, told: Sequence[str]) -> dict[str, FieldNotes]:
    """What a result repeats of the notes: the scene's, with what was ``told`` of it now, and those of its object."""
    scene = notes.get("scene", NO_NOTES)
    scene = replace(scene, warnings=(*scene.warnings, *(f"NOTE: {note}" for note in told)))
    return {"scene": scene, "object": notes.get(obj or "", NO_NOTES)}


def core_importer(limits: ImportLimits) -> Importer:
    """The importer of regnf_core within ``limits``, and of regnf_data for recordings."""

    def run(
        upload: Path, folder: Path, description: dict[str, Any], settings: Path | None, cameras: Path | None
    ) -> dict[str, Any]:
        if description.get("as") == RECORDING:
            from regnf_data.recordings.importing import import_recording

            of_record = ("as", "after", "frame")
            said = {name: value for name, value in description.items() if name not in of_record}
            return import_recording(upload, folder, said, limits)
        report = import_field(
            upload, folder, description or None, limits, settings=settings, cameras=cameras, ask_by_picture=True
        )
        return report.to_dict()

    return run


# The result document of a rendering.


def write_result(folder: Path, request: RenderRequest, report: RenderReport, engine: dict[str, Any]) -> list[str]:
    """Write ``result.json`` beside the files of a rendering; the names of all that is to be kept."""
    names = [one.name for one in report.artifacts]
    document = {
        "frames": request.frames,
        "size": list(request.image_size),
        "depth_unit": report.depth_unit,
        "seconds": report.seconds,
        "field": digest_of(folder / EDITED_FIELD) if EDITED_FIELD in names else None,
        "seed": request.seed,
        "options": asdict(request.options),
        "engine": engine,
        "artifacts": [asdict(one) for one in report.artifacts],
    }
    (folder / "result.json").write_text(json.dumps(document), encoding="utf-8")
    return [*names, "result.json"]
