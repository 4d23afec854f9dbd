"""``regnf populate``: all objects of a library in a scene; ``regnf compare``: what changed between two scenes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

import regnf_cli.options as cli
from regnf_cli.guard import loading, require
from regnf_cli.register import objects_of
from regnf_cli.registration import modeled
from regnf_cli.report import EXIT_NOT_REGISTERED, out, reporting, say, tell
from regnf_core.detections.images import image_detection_in_field, read_detection
from regnf_core.errors import InvalidInputError, filled_folder, require_writable
from regnf_core.field_source import FieldSource
from regnf_core.options import RegistrationOptions
from regnf_core.processes import keep_freed_memory
from regnf_core.texts import json_value

if TYPE_CHECKING:
    from regnf_core.fields.observation import SdfField
    from regnf_core.geometry.box import OrientedBox
    from regnf_core.library import LibraryObject
    from regnf_core.population.placements import Placement
    from regnf_core.population.populate import Population

Library = Annotated[
    list[Path] | None,
    typer.Argument(
        help="The objects: libraries, folders of fields, or fields. Default: your library.",
        parser=cli.library_path,
        metavar="[LIBRARY]...",
    ),
]
Tag = Annotated[str | None, typer.Option(help="Use only library entries with this tag.")]
Options = Annotated[Path | None, typer.Option(help="JSON file with options of the preset robust.", **cli.FILE)]
ObjectDescription = Annotated[
    dict[str, Any] | None,
    typer.Option(help="Import options that are not in the objects' files: a JSON file, or JSON.", **cli.DESCRIPTION),
]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Number of processes that share the work. Default: one per core.")
]
Worlds = Annotated[
    str,
    typer.Option(
        help="Files to write besides placements.json: glb, usd, mjcf, sdf, urdf.", metavar="LIST", show_default=True
    ),
]
_WORLDS = ("glb", "usd", "mjcf", "sdf", "urdf")


def populate(
    scene: cli.Scene,
    library: Library = None,
    tag: Tag = None,
    detections: Annotated[
        Path | None,
        typer.Option(help="JSON file with boxes of a detector, which are searched first: a list.", **cli.FILE),
    ] = None,
    options: Options = None,
    object_unit: cli.ObjectUnit = None,
    scale: cli.Scale = "known",
    scene_description: cli.SceneDescription = None,
    object_description: ObjectDescription = None,
    processes: Processes = None,
    seed: cli.Seed = 0,
    output: Annotated[
        Path | None, typer.Option(help="Output folder for the placements and worlds.", **cli.OUTPUT)
    ] = None,
    worlds: Worlds = "glb",
    as_json: cli.AsJson = False,
) -> None:
    """Find all objects of a library in a scene, without boxes: where each stands, and what is left over.

    Example: **regnf populate room.ckpt chairs/ --object-unit m --output populated/**

    Exit codes: 0 something was placed, 1 nothing was, 2 bad input.
    """
    require("engine")
    keep_freed_memory()
    asked = _Asked(cli.read_options(options, "robust", object_unit, scale), seed, processes)
    kinds = _world_kinds(worlds)
    if output is not None:
        require_writable(output)
    boxes = [] if detections is None else _boxes(detections, scene)
    place = _field(scene, scene_description)
    objects = _sources(library, tag, object_description)
    with reporting("loading") as report:
        (field,), models = _opened([place], objects, asked, report)
        found = asked.populate(field, models, boxes, report, 0, 1)
    document = found.to_dict()
    if as_json:
        out.print_json(json.dumps(document))
    else:
        _show(found)
    if output is not None:
        from regnf_core.population.worlds import write_worlds

        with filled_folder(output) as folder:
            (folder / "placements.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
            files = {str(one.named): one.file for one in objects}
            (folder / "edits.json").write_text(json.dumps(_edits(found, files), indent=1), encoding="utf-8")
            write_worlds(found, folder, kinds)
        tell(f"wrote {output}: placements.json, edits.json, {', '.join(kinds)}")
    raise typer.Exit(0 if found.placements else EXIT_NOT_REGISTERED)


def compare(
    before: cli.Scene,
    after: cli.Scene,
    library: Library = None,
    tag: Tag = None,
    options: Options = None,
    object_unit: cli.ObjectUnit = None,
    scale: cli.Scale = "known",
    scene_description: cli.SceneDescription = None,
    object_description: ObjectDescription = None,
    processes: Processes = None,
    seed: cli.Seed = 0,
    output: Annotated[Path | None, typer.Option(help="File to write, .json.", metavar="FILE")] = None,
    as_json: cli.AsJson = False,
) -> None:
    """Find which objects stayed, moved, are gone or new between two maps of a place. Both maps share their frame.

    Example: **regnf compare monday.safetensors tuesday.safetensors library/ --object-unit m**
    """
    require("engine")
    keep_freed_memory()
    asked = _Asked(cli.read_options(options, "robust", object_unit, scale), seed, processes)
    places = [_field(one, scene_description) for one in (before, after)]
    objects = _sources(library, tag, object_description)
    with reporting("loading") as report:
        from regnf_core.population.calls import Changes
        from regnf_core.population.compare import compare as changes_between

        (old, new), models = _opened(places, objects, asked, report)
        first = asked.populate(old, models, [], report, 0, 2)
        second = asked.populate(new, models, [], report, 1, 2)
        changes = Changes(first, second, changes_between((old, first), (new, second), models))
    document = changes.to_dict()
    if output is not None:
        output.write_text(json.dumps(document, indent=1), encoding="utf-8")
    if as_json:
        out.print_json(json.dumps(document))
        return
    table = Table("change", "object", "moved", "probability", box=None, header_style="bold")
    for one in changes.objects:
        moved = f"{one.moved:.4g}" if one.change == "moved" else ""
        table.add_row(one.change, one.name, moved, f"{one.probability:.3f}")
    out.print(table if changes.objects else "no object of the library is in either map")


class _Asked:
    """What was asked for. Needs no engine."""

    def __init__(self, options: dict[str, Any], seed: int, processes: int | None) -> None:
        self.options, self.seed, self._processes = RegistrationOptions.from_dict(options), seed, processes

    def populate(
        self,
        field: SdfField,
        library: Sequence[LibraryObject],
        boxes: Sequence[OrientedBox],
        report: Any,
        number: int,
        of: int,
    ) -> Population:
        """report: of ``reporting`` · number: of this scene among ``of`` scenes."""
        from regnf_core.population.calls import cores
        from regnf_core.population.populate import populate as populate_scene

        def watch(share: float, placed: Sequence[Placement]) -> None:
            report(f"{len(placed)} placed", (number + share) / of)

        processes = self._processes or cores()
        return populate_scene(field, library, self.options, self.seed, boxes, processes, watch)


def _field(scene: Path, description: dict[str, Any] | None) -> FieldSource:
    if cli.is_recording(scene):
        hint = f"Make a map of it first: regnf fuse {scene} map.safetensors"
        raise InvalidInputError(f"{scene}: a recording, expected a field", reason="NO_FIELD", hint=hint)
    return cli.source_of(scene, description, cli.choice_of(None, False), "scene")


def _sources(library: list[Path] | None, tag: str | None, description: dict[str, Any] | None) -> list[FieldSource]:
    found = objects_of(library, tag)
    choice = cli.choice_of(None, False)
    return [cli.source_of(one, description, choice, "object") if isinstance(one, Path) else one for one in found]


def _opened(
    places: Sequence[FieldSource], objects: list[FieldSource], asked: _Asked, report: Any
) -> tuple[list[SdfField], list[LibraryObject]]:
    with loading():
        from regnf_core.loading import import_smallest_first, load_field

    import_smallest_first([*places, *objects])
    fields = [load_field(one).field for one in places]
    library, unusable = modeled(objects, asked.options.robust, partial(report, "library"))
    for name, reason in unusable.items():
        tell(f"warning: {name} is no object ({reason})")
    return fields, library


def _boxes(path: Path, scene: Path) -> list[OrientedBox]:
    from regnf_core.detections import Detection
    from regnf_core.geometry.box import OrientedBox

    values = json_value(path.read_bytes(), f"detections {path}: ")
    found = [read_detection(one) for one in (values if isinstance(values, list) else [values])]
    boxes = []
    for one in found:
        if not isinstance(one, Detection):
            raise image_detection_in_field(scene)
        boxes.append(OrientedBox.from_detection(one))
    return boxes


def _world_kinds(text: str) -> list[str]:
    kinds = [one.strip() for one in text.split(",") if one.strip()]
    for kind in kinds:
        if kind not in _WORLDS:
            hint = f"Choose of {', '.join(_WORLDS)}."
            raise InvalidInputError(f"--worlds {kind}: not a kind of world", reason="INVALID_OPTIONS", hint=hint)
    return kinds


def _edits(found: Population, files: dict[str, Path]) -> list[dict[str, Any]]:
    """Edits that put each object's own field into the scene, for ``regnf edit``."""
    return [
        {
            "kind": "substitution",
            "object": str(files[one.name].resolve()),
            "T_object_scene": one.T_object_scene.matrix().tolist(),
            "name": one.name[-_MOST_NAME:],
        }
        for one in found.placements
    ]


_MOST_NAME = 64


def _show(found: Population) -> None:
    table = Table("object", "center in the scene", "scale", "probability", "", box=None, header_style="bold")
    for one in found.placements:
        center = " ".join(f"{value:.4g}" for value in found.box(one).center.tolist())
        several = f"{len(one.alternatives) + 1} equal poses" if one.alternatives else ""
        table.add_row(one.name, center, f"{float(one.T_object_scene.scale):.4g}", f"{one.probability:.3f}", several)
    out.print(table if found.placements else "no object of the library was found")
    for one in found.unsure:
        say(f"unsure: {one.name}, probability {one.probability:.2f}")
    share = 100 * float(found.free.mean()) if len(found.free) else 0.0
    say(f"{share:.0f} % of the surface off floor and walls is not explained, in {len(found.unexplained)} pieces")
